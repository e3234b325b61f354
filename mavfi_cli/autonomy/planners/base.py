"""What every planner gets and gives."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mavfi_cli.autonomy import grid as grids
from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.core.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningParams:
    """How far to stay from obstacles.

    The planning radius is larger than the collision check's, so that a plan is not found blocked
    by what the next frame adds at its edges (depth is quantised to 0.1 m).
    """

    radius_m: float = 1.1
    escape_radius_m: float = 2.2  # near a start that is too close to an obstacle, less will do


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningProblem:
    """From where to where, through what."""

    start_enu_m: FloatArray  # (3,)
    goal_enu_m: FloatArray  # (3,)
    grid: ObstacleGrid  # bounds, and where the vehicle's centre must not be


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanResult:
    """A path, or an honest failure: an approximate path is none."""

    found: bool
    path_enu_m: FloatArray  # (n, 3) from start to goal; (0, 3) where none was found
    reason: str = ""  # why there is none
    nearest_m: float = 0.0  # how near to the goal the search came
    iterations: int = 0

    @property
    def length_m(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.path_enu_m, axis=0), axis=1).sum())


class Planner(Protocol):
    """A path planner whose result is a function of problem and seed alone."""

    @property
    def name(self) -> str:
        """What the planner is found by."""

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """Find a path from the problem's start to its goal.

        The result must repeat for the same problem and seed, whatever was planned before in the
        process, and must come after a bounded number of steps, not of seconds.
        """


def failure(problem: PlanningProblem, reason: str) -> PlanResult:
    """No path, and nothing was searched."""
    gap_m = math.dist(problem.goal_enu_m, problem.start_enu_m)
    return PlanResult(found=False, path_enu_m=np.empty((0, 3)), reason=reason, nearest_m=gap_m)


def pose_problem(
    snapshot: MapSnapshot,
    start_enu_m: FloatArray,
    goal_enu_m: FloatArray,
    bounds_enu_m: FloatArray,
    params: PlanningParams,
) -> PlanningProblem:
    """The problem of flying from start to goal (3,) inside the bounds (6,) on this map.

    The bounds are widened to hold the start, as in the reference. Where the start is too close
    to an obstacle, the planning radius shrinks stepwise (3/4, 1/2, 1/4, 0) within
    `escape_radius_m` of it until it is free, so that the vehicle can leave. A goal that is too
    close to an obstacle stays blocked.
    """
    bounds = np.array(bounds_enu_m, np.float64)
    if np.isfinite(start_enu_m).all():
        bounds[:3] = np.minimum(bounds[:3], start_enu_m)
        bounds[3:] = np.maximum(bounds[3:], start_enu_m)
    grid = grids.build(snapshot, bounds, params.radius_m)
    if not grid.point_free(start_enu_m) and np.isfinite(start_enu_m).all():
        grid = _escape(snapshot, grid, start_enu_m, params)
    return PlanningProblem(
        start_enu_m=np.asarray(start_enu_m, np.float64),
        goal_enu_m=np.asarray(goal_enu_m, np.float64),
        grid=grid,
    )


def _escape(
    snapshot: MapSnapshot, grid: ObstacleGrid, start: FloatArray, params: PlanningParams
) -> ObstacleGrid:
    """The grid with a smaller radius around the start; unchanged where even none would do."""
    for share in (0.75, 0.5, 0.25, 0.0):
        smaller = grids.build(snapshot, grid.bounds_enu_m, share * params.radius_m)
        if smaller.point_free(start):
            blocked = grids.blend(grid, smaller, start, params.escape_radius_m)
            return replace(grid, blocked=blocked)
    return grid


def refuse(problem: PlanningProblem) -> PlanResult | None:
    """A failure where start or goal cannot be flown at all, else None."""
    if not problem.grid.point_free(problem.start_enu_m):
        return failure(problem, "start blocked")
    if not problem.grid.point_free(problem.goal_enu_m):
        return failure(problem, "goal blocked")
    return None
