"""What our planners are called; without OMPL, so that a configuration is cheap to make."""

from __future__ import annotations

OURS = ("rrtstar", "rrt", "rrtconnect")


def canonical(name: str) -> str:
    """The one name of a planner under which it is recorded and grouped.

    Case, hyphens, underscores and the star of RRT* do not matter for our own; any other name is
    returned as it is.
    """
    plain = name.lower().replace("*", "star").replace("-", "").replace("_", "")
    return plain if plain in OURS else name
