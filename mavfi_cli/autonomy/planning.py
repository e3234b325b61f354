"""The planning stage: search a path, shorten it, smooth it into a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field

from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.orders import PlanFailure, PlanRequest
from mavfi_cli.autonomy.planners.base import Planner, PlanningParams, pose_problem
from mavfi_cli.autonomy.shortcut import shortcut, subdivided
from mavfi_cli.autonomy.smoothing import SmoothingParams, smooth
from mavfi_cli.core.types import FloatArray, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class StageParams:
    """Parameters of the planning stage."""

    clearance: PlanningParams = field(default_factory=PlanningParams)
    smoothing: SmoothingParams = field(default_factory=SmoothingParams)
    shortcut_spacing_m: float = 1.0  # vertex spacing of the path before the second shortcut


def plan(
    planner: Planner,
    request: PlanRequest,
    snapshot: MapSnapshot,
    *,
    bounds_enu_m: FloatArray,
    seed: int,
    params: StageParams,
) -> Trajectory | PlanFailure:
    """Plan from the request's position to its goal.

    If the vehicle departs in motion and cannot stop in free space, there is no trajectory. It must
    brake first.

    Args:
        request: Start, goal, and the numbers of the trajectory.
        snapshot: Newest map.
        bounds_enu_m: Allowed volume (6,), xmin ymin zmin xmax ymax zmax.
    """
    start, goal = request.position_enu_m, request.goal_enu_m
    problem = pose_problem(snapshot, start, goal, bounds_enu_m, params.clearance)
    result = planner.plan(problem, seed)
    if not result.found:
        return PlanFailure(stamp_s=request.stamp_s, reason=result.reason)
    path = shortcut(result.path_enu_m, problem.grid)
    path = shortcut(subdivided(path, params.shortcut_spacing_m), problem.grid)
    smoothed = smooth(path, problem.grid, request, params.smoothing)
    if not smoothed.free:
        return PlanFailure(stamp_s=request.stamp_s, reason="no free way on")
    return smoothed.trajectory
