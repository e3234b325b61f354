"""Path planners by name: ours, and those that other packages register under `mavfi.planners`."""

from mavfi_cli.autonomy import canonical_planner
from mavfi_cli.autonomy.planners.base import (
    Planner,
    PlanningParams,
    PlanningProblem,
    PlanResult,
    pose_problem,
)
from mavfi_cli.autonomy.planners.ompl import OMPL_PLANNERS
from mavfi_cli.core.installed import installed, load_plug_in

__all__ = [
    "PlanResult",
    "Planner",
    "PlanningParams",
    "PlanningProblem",
    "find",
    "names",
    "pose_problem",
]

_ENTRY_POINT_GROUP = "mavfi.planners"

_OURS = {planner.name: planner for planner in OMPL_PLANNERS}


def names() -> list[str]:
    """Return the names of all installed planners, ours first."""
    others = installed(_ENTRY_POINT_GROUP).names
    return [*_OURS, *sorted(others - set(_OURS))]


def find(name: str) -> Planner:
    """Return the planner of that name with its default settings.

    Names of our own planners may be spelt differently; see `canonical_planner`.

    Raises:
        UnknownName: No planner has this name. Suggests the nearest.
        MavfiError: Its package does not load.
    """
    plain = canonical_planner(name)
    if plain in _OURS:
        return _OURS[plain]
    planner: Planner = load_plug_in(_ENTRY_POINT_GROUP, "planner", name, names())()
    return planner
