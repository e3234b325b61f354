"""Path planners, found by name. Other packages add planners by entry point."""

from mavfi_cli.autonomy.planners.base import (
    Planner,
    PlanningParams,
    PlanningProblem,
    PlanResult,
    pose_problem,
)
from mavfi_cli.autonomy.planners.registry import find, names

__all__ = [
    "PlanResult",
    "Planner",
    "PlanningParams",
    "PlanningProblem",
    "find",
    "names",
    "pose_problem",
]
