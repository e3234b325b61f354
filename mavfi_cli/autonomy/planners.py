"""The planning stage: search for a path, shorten it, smooth it into a trajectory.

Other packages register planners in the entry-point group `mavfi.planners`. Ours are OMPL's:
RRT* (Karaman and Frazzoli 2011), RRT (LaValle 1998) and RRTConnect (Kuffner 2000).

OMPL's random generators take their seeds from a process-wide sequence when they are created. Each
search resets that sequence first and creates its generators afterwards, so its result depends only
on the problem and the seed. OMPL warns that earlier generators keep their seeds; none of them is
used. The search stops after a number of iterations; it has no time limit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from mavfi_cli.autonomy import OUR_PLANNERS, SMOOTHERS, canonical_planner
from mavfi_cli.autonomy.grid import GridTooLarge, ObstacleGrid, segment_free
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanFailure, PlanRequest
from mavfi_cli.autonomy.smoothing import SmoothingParams, smooth, smooth_as_released
from mavfi_cli.core.frames import norm
from mavfi_cli.core.installed import PlugIns
from mavfi_cli.core.types import FloatArray, Trajectory

MAX_SEED = 0x7FFF_FFFF
_SMOOTHERS = dict(zip(SMOOTHERS, (smooth, smooth_as_released), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningParams:
    """Parameters of the planning stage.

    The planning radius is larger than the collision check's. A plan thus stays free when the next
    frame adds voxels at the edges of obstacles (depth is quantised to 0.1 m).
    """

    radius_m: float = 1.1  # clearance from obstacles
    escape_radius_m: float = 2.2  # within this distance of a blocked start, the radius may shrink
    shortcut_spacing_m: float = 1.0  # largest distance between vertices before the 2nd shortcut
    smoother: str = SMOOTHERS[0]
    smoothing: SmoothingParams = field(default_factory=SmoothingParams)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningProblem:
    """Start, goal and obstacles of a planning problem."""

    start_enu_m: FloatArray  # (3,)
    goal_enu_m: FloatArray  # (3,)
    grid: ObstacleGrid  # bounds and blocked voxels

    @classmethod
    def pose(
        cls,
        snapshot: MapSnapshot,
        start_enu_m: FloatArray,
        goal_enu_m: FloatArray,
        bounds_enu_m: FloatArray,
        params: PlanningParams,
    ) -> Self:
        """Build the problem of flying from start to goal, each (3,), inside the bounds (6,).

        The bounds are widened to include the start, as in MAVBench. If the start is too close to an
        obstacle, the planning radius within `escape_radius_m` of it shrinks stepwise (3/4, 1/2,
        1/4, 0) until the start is free, so that the vehicle can leave. A goal too close to an
        obstacle stays blocked.
        """
        bounds = np.array(bounds_enu_m, np.float64)
        start = np.asarray(start_enu_m, np.float64)
        finite = np.isfinite(start).all()
        if finite:
            bounds[:3] = np.minimum(bounds[:3], start)
            bounds[3:] = np.maximum(bounds[3:], start)
        grid = ObstacleGrid.build(snapshot, bounds, params.radius_m)
        if finite and not grid.point_free(start):
            for share in (0.75, 0.5, 0.25, 0.0):
                smaller = ObstacleGrid.build(snapshot, bounds, share * params.radius_m)
                if smaller.point_free(start):
                    grid = grid.blended(smaller, start, params.escape_radius_m)
                    break
        goal = np.asarray(goal_enu_m, np.float64)
        return cls(start_enu_m=start, goal_enu_m=goal, grid=grid)

    def refused(self) -> PlanResult | None:
        """Return a failure if the start or the goal is blocked, or None if both are free."""
        for place, name in ((self.start_enu_m, "start"), (self.goal_enu_m, "goal")):
            if not self.grid.point_free(place):
                distance_m = math.dist(self.goal_enu_m, self.start_enu_m)
                return PlanResult.failure(f"{name} blocked", distance_m)
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanResult:
    """The result of a search: a path or a failure. A path short of the goal is a failure."""

    found: bool
    path_enu_m: FloatArray  # (n, 3) from start to goal; (0, 3) if none was found
    reason: str = ""  # cause of a failure
    nearest_m: float = 0.0  # shortest distance to the goal that the search reached

    @classmethod
    def failure(cls, reason: str, nearest_m: float) -> Self:
        """Return a failure. `nearest_m` is the shortest distance to the goal that was reached."""
        return cls(found=False, path_enu_m=np.empty((0, 3)), reason=reason, nearest_m=nearest_m)


class Planner(Protocol):
    """A path planner whose result depends only on the problem and the seed."""

    @property
    def name(self) -> str:
        """Name of the planner in settings and records."""

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """Find a path from the problem's start to its goal.

        The result must be the same for the same problem and seed, whatever the process planned
        before. The number of steps must be bounded; a time limit is not allowed.
        """


def plan(
    planner: Planner,
    request: PlanRequest,
    snapshot: MapSnapshot,
    *,
    bounds_enu_m: FloatArray,
    seed: int,
    params: PlanningParams,
) -> Trajectory | PlanFailure:
    """Plan a trajectory from the request's position to its goal. Return it, or a failure.

    If the vehicle is moving and cannot stop in free space, the plan fails, because the vehicle
    must brake first.

    Args:
        request: Start, goal, and the sequence numbers of the trajectory.
        snapshot: Newest map.
        bounds_enu_m: Allowed volume (6,), xmin ymin zmin xmax ymax zmax.
    """
    try:
        problem = PlanningProblem.pose(
            snapshot, request.position_enu_m, request.goal_enu_m, bounds_enu_m, params
        )
    except GridTooLarge:
        return PlanFailure(stamp_s=request.stamp_s, reason="obstacles too far apart for a map")
    result = planner.plan(problem, seed)
    if not result.found:
        return PlanFailure(stamp_s=request.stamp_s, reason=result.reason)
    path = _shortcut(result.path_enu_m, problem.grid)
    path = _shortcut(_subdivided(path, params.shortcut_spacing_m), problem.grid)
    smoother = _SMOOTHERS[params.smoother]
    trajectory, free = smoother(path, problem.grid, request, params.smoothing)
    return trajectory if free else PlanFailure(stamp_s=request.stamp_s, reason="no free way on")


def _shortcut(path_enu_m: FloatArray, grid: ObstacleGrid) -> FloatArray:
    """Connect each vertex of a path (n, 3) to the farthest later vertex in line of sight.

    The result has the same start and end and is never longer. It is free if the path was free. The
    greedy rule is that of the released planner (MAVBench/MAV_apps, branch mavfi).
    """
    kept = [0]
    last = len(path_enu_m) - 1
    while kept[-1] < last:
        here, there = kept[-1], last
        while there > here + 1 and not grid.segment_free(path_enu_m[here], path_enu_m[there]):
            there -= 1
        kept.append(there)
    return np.ascontiguousarray(path_enu_m[kept])


def _subdivided(path_enu_m: FloatArray, spacing_m: float) -> FloatArray:
    """Subdivide a path into vertices (m, 3) at most `spacing_m` apart."""
    pieces = [path_enu_m[:1]]
    for start, end in itertools.pairwise(path_enu_m):
        count = max(1, math.ceil(norm(end - start) / spacing_m))
        shares = np.arange(1, count + 1)[:, None] / count
        pieces.append(start + shares * (end - start))
    return np.vstack(pieces)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Search:
    iterations: int
    range_m: float  # longest step of the tree
    optimise: bool = False  # continue after the first solution until the iterations are used up


@dataclass(frozen=True, slots=True, kw_only=True)
class _OmplPlanner:
    """One of OMPL's planners. It runs its searches in order until one of them finds a path.

    If the straight line from start to goal is free, that line is the path.
    """

    name: str
    kind: Any  # class of `ompl.geometric`
    settings: Mapping[str, float]  # name of a setter -> its argument
    searches: tuple[_Search, ...]

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """See `Planner.plan`."""
        if (refusal := problem.refused()) is not None:
            return refusal
        start, goal = problem.start_enu_m, problem.goal_enu_m
        if problem.grid.segment_free(start, goal):
            return PlanResult(found=True, path_enu_m=np.vstack([start, goal]))
        for search in self.searches:
            result = self._search(problem, seed, search)
            if result.found:
                break
        return result

    def _search(self, problem: PlanningProblem, seed: int, search: _Search) -> PlanResult:
        ou.setLogLevel(ou.LogLevel.LOG_NONE)
        ou.RNG.setSeed(seed % MAX_SEED + 1)
        space, information = _space(problem.grid)
        definition = ob.ProblemDefinition(information)
        ends = space.allocState(), space.allocState()
        for state, point in zip(ends, (problem.start_enu_m, problem.goal_enu_m), strict=True):
            for axis in range(3):
                state[axis] = float(point[axis])
        definition.setStartAndGoalStates(*ends, 1e-6)
        objective = ob.PathLengthOptimizationObjective(information)
        if not search.optimise:
            objective.setCostThreshold(ob.Cost(math.inf))
        definition.setOptimizationObjective(objective)
        planner = self.kind(information)
        planner.setRange(search.range_m)
        for setter, value in self.settings.items():
            getattr(planner, setter)(value)
        planner.setProblemDefinition(definition)
        planner.setup()
        begun = itertools.count(1)
        planner.solve(ob.PlannerTerminationCondition(lambda: next(begun) > search.iterations))
        return _result(problem, definition, next(begun) - 1)


class _GridMotions(ob.MotionValidator):  # type: ignore[misc]
    """OMPL's motion validator, which tests straight segments on the obstacle grid.

    It holds no reference to OMPL objects.
    """

    def __init__(self, information: Any, grid: ObstacleGrid) -> None:
        super().__init__(information)
        self._arguments = grid.arguments

    def checkMotion(self, a: Any, b: Any) -> bool:  # noqa: N802
        """Return True if the straight motion from state a to state b is free."""
        return segment_free(*self._arguments, a[0], a[1], a[2], b[0], b[1], b[2])


def _space(grid: ObstacleGrid) -> tuple[Any, Any]:
    space = ob.RealVectorStateSpace(3)
    bounds = ob.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(grid.bounds_enu_m[axis]))
        bounds.setHigh(axis, float(grid.bounds_enu_m[3 + axis]))
    space.setBounds(bounds)
    information = ob.SpaceInformation(space)
    arguments = grid.arguments

    def valid(state: Any) -> bool:
        x, y, z = state[0], state[1], state[2]
        return segment_free(*arguments, x, y, z, x, y, z)

    information.setStateValidityChecker(valid)
    information.setMotionValidator(_GridMotions(information, grid))
    information.setup()
    return space, information


def _result(problem: PlanningProblem, definition: Any, iterations: int) -> PlanResult:
    if not definition.hasExactSolution():
        gap_m = math.dist(problem.goal_enu_m, problem.start_enu_m)
        if definition.hasApproximateSolution():
            gap_m = min(gap_m, float(definition.getSolutionDifference()))
        return PlanResult.failure(f"no path within {iterations} iterations", gap_m)
    states = definition.getSolutionPath().getStates()
    path = np.array([[state[0], state[1], state[2]] for state in states])
    path[0], path[-1] = problem.start_enu_m, problem.goal_enu_m
    return PlanResult(found=True, path_enu_m=path)


_GOAL_BIAS = {"setGoalBias": 0.05}  # OMPL's default
_FIRST_SOLUTION = (_Search(iterations=5000, range_m=10.0),)  # for dense maps, steps below OMPL's
_OURS = {
    planner.name: planner
    for planner in (
        # After the first solution, RRT* samples only states that could shorten the path (Gammell et
        # al. 2014). 300 iterations with this restriction give shorter paths than 500 without, at
        # half the cost. Only hard maps incur the cost of the second search.
        _OmplPlanner(
            name="rrtstar",
            kind=og.RRTstar,
            settings={**_GOAL_BIAS, "setRewireFactor": 1.1, "setInformedSampling": True},
            searches=(
                _Search(iterations=300, range_m=25.0, optimise=True),
                _Search(iterations=2000, range_m=5.0),
            ),
        ),
        _OmplPlanner(name="rrt", kind=og.RRT, settings=_GOAL_BIAS, searches=_FIRST_SOLUTION),
        _OmplPlanner(name="rrtconnect", kind=og.RRTConnect, settings={}, searches=_FIRST_SOLUTION),
    )
}


PLANNERS = PlugIns("mavfi.planners", "planner", OUR_PLANNERS)


def find(name: str) -> Planner:
    """Return the planner called `name`, with its default settings.

    Names of our own planners may be spelt differently; see `canonical_planner`.

    Raises:
        UnknownName: No planner has this name. The message suggests the nearest.
        MavfiError: The package of the planner cannot be loaded.
    """
    plain = canonical_planner(name)
    if plain in _OURS:
        return _OURS[plain]
    planner: Planner = PLANNERS.load(name)()
    return planner
