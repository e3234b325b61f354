"""The planning stage: search a path, shorten it, smooth it into a trajectory."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanFailure, PlanRequest
from mavfi_cli.autonomy.planners.base import Planner, PlanningParams, pose_problem
from mavfi_cli.autonomy.smoothing import SmoothingParams, smooth
from mavfi_cli.core.types import FloatArray, Trajectory


def shortcut(path_enu_m: FloatArray, grid: ObstacleGrid) -> FloatArray:
    """Connect each vertex of a path (n, 3) to the farthest later vertex in line of sight.

    The result has the same start and end and is never longer. It is free if the path was free. The
    greedy rule is that of the released planner (MAVBench/MAV_apps, branch mavfi).
    """
    kept = [0]
    last = len(path_enu_m) - 1
    while kept[-1] < last:
        here = kept[-1]
        there = last
        while there > here + 1 and not grid.segment_free(path_enu_m[here], path_enu_m[there]):
            there -= 1
        kept.append(there)
    return np.ascontiguousarray(path_enu_m[kept])


def subdivided(path_enu_m: FloatArray, spacing_m: float) -> FloatArray:
    """Subdivide a path into vertices (m, 3) at most `spacing_m` apart."""
    pieces = [path_enu_m[:1]]
    for start, end in itertools.pairwise(path_enu_m):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / spacing_m)))
        shares = np.arange(1, count + 1)[:, None] / count
        pieces.append(start + shares * (end - start))
    return np.vstack(pieces)


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
