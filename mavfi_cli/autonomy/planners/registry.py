"""Registry of planners: ours, and those that other packages register under `mavfi.planners`."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points

from mavfi_cli.autonomy.planner_names import OURS, canonical
from mavfi_cli.autonomy.planners.base import Planner
from mavfi_cli.autonomy.planners.rrt import RRT
from mavfi_cli.autonomy.planners.rrt_connect import RRTConnect
from mavfi_cli.autonomy.planners.rrt_star import RRTStar
from mavfi_cli.core.errors import UnknownName

ENTRY_POINT_GROUP = "mavfi.planners"

_OURS: dict[str, Callable[[], Planner]] = dict(zip(OURS, (RRTStar, RRT, RRTConnect), strict=True))


def names() -> list[str]:
    """Return the names of all installed planners, ours first."""
    others = {entry.name for entry in entry_points(group=ENTRY_POINT_GROUP)}
    return [*_OURS, *sorted(others - set(_OURS))]


def find(name: str) -> Planner:
    """Return the planner of that name with its default settings.

    Names of our own planners may be spelt differently; see `planner_names.canonical`.

    Raises:
        UnknownName: No planner has this name. Suggests the nearest.
    """
    plain = canonical(name)
    if plain in _OURS:
        return _OURS[plain]()
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            planner: Planner = entry.load()()
            return planner
    raise UnknownName("planner", name, names())
