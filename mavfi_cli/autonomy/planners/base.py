"""Interface of a path planner: parameters, problem and result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.core.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningParams:
    """Clearance from obstacles.

    The planning radius is larger than the collision check's. A plan thus stays free when the next
    frame adds voxels at the edges of obstacles (depth is quantised to 0.1 m).
    """

    radius_m: float = 1.1
    escape_radius_m: float = 2.2  # within this distance of a blocked start, the radius may shrink


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningProblem:
    """Start, goal and obstacles of a planning problem."""

    start_enu_m: FloatArray  # (3,)
    goal_enu_m: FloatArray  # (3,)
    grid: ObstacleGrid  # bounds and blocked voxels


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanResult:
    """A path or a failure. A path that ends short of the goal is a failure."""

    found: bool
    path_enu_m: FloatArray  # (n, 3) from start to goal; (0, 3) if none was found
    reason: str = ""  # cause of a failure
    nearest_m: float = 0.0  # shortest distance to the goal that the search reached
    iterations: int = 0

    @property
    def length_m(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.path_enu_m, axis=0), axis=1).sum())


class Planner(Protocol):
    """A path planner whose result depends on problem and seed only."""

    @property
    def name(self) -> str:
        """Name by which the planner is found."""

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """Find a path from the problem's start to its goal.

        The result must be the same for the same problem and seed, whatever the process planned
        before. The number of steps must be bounded; a time limit is not allowed.
        """


def pose_problem(
    snapshot: MapSnapshot,
    start_enu_m: FloatArray,
    goal_enu_m: FloatArray,
    bounds_enu_m: FloatArray,
    params: PlanningParams,
) -> PlanningProblem:
    """Build the problem of flying from start to goal, each (3,), inside the bounds (6,).

    The bounds are widened to hold the start, as in MAVBench. If the start is too close to an
    obstacle, the planning radius within `escape_radius_m` of it shrinks stepwise (3/4, 1/2, 1/4,
    0) until the start is free, so that the vehicle can leave. A goal too close to an obstacle
    stays blocked.
    """
    bounds = np.array(bounds_enu_m, np.float64)
    if np.isfinite(start_enu_m).all():
        bounds[:3] = np.minimum(bounds[:3], start_enu_m)
        bounds[3:] = np.maximum(bounds[3:], start_enu_m)
    grid = ObstacleGrid.build(snapshot, bounds, params.radius_m)
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
    """Reduce the radius around the start. Return the grid unchanged if even radius 0 is blocked."""
    for share in (0.75, 0.5, 0.25, 0.0):
        smaller = ObstacleGrid.build(snapshot, grid.bounds_enu_m, share * params.radius_m)
        if smaller.point_free(start):
            return grid.blended(smaller, start, params.escape_radius_m)
    return grid


def refuse(problem: PlanningProblem) -> PlanResult | None:
    """Return a failure if start or goal is blocked, else None."""
    start, goal = problem.start_enu_m, problem.goal_enu_m
    for place, reason in ((start, "start blocked"), (goal, "goal blocked")):
        if not problem.grid.point_free(place):
            return PlanResult(
                found=False, path_enu_m=np.empty((0, 3)), reason=reason,
                nearest_m=math.dist(goal, start),
            )  # fmt: skip
    return None
