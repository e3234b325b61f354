"""Names of our planners. Does not import OMPL, so that a configuration is cheap to make."""

from __future__ import annotations

OURS = ("rrtstar", "rrt", "rrtconnect")


def canonical(name: str) -> str:
    """Return the canonical name of a planner, under which records and groups list it.

    For our own planners, case, hyphens, underscores and the star of RRT* do not matter. Any other
    name is returned unchanged.
    """
    plain = name.lower().replace("*", "star").replace("-", "").replace("_", "")
    return plain if plain in OURS else name
