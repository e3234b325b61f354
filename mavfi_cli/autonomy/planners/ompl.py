"""OMPL's planners: RRT* (Karaman and Frazzoli 2011), RRT (LaValle 1998), RRTConnect (Kuffner 2000).

OMPL's random generators take their seeds from a process-wide sequence when they are created. Each
search resets that sequence first and creates its generators afterwards, so its result depends on
problem and seed only. OMPL warns that earlier generators keep their seeds; none of them is used.
The search stops after a number of iterations, never after a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from mavfi_cli.autonomy.grid import ObstacleGrid, segment_free
from mavfi_cli.autonomy.planners.base import PlanningProblem, PlanResult, refuse
from mavfi_cli.core.types import FloatArray

MAX_SEED = 0x7FFF_FFFF


@dataclass(frozen=True, slots=True, kw_only=True)
class _Search:
    """Settings of an OMPL search."""

    make: Callable[[Any], Any]  # space information -> configured OMPL planner
    iterations: int
    optimise: bool = False  # continue after the first solution until the iterations are used up


class _GridMotions(ob.MotionValidator):  # type: ignore[misc]
    """Segment test on the obstacle grid. Holds no reference to OMPL objects."""

    def __init__(self, information: Any, grid: ObstacleGrid) -> None:
        super().__init__(information)
        self._arguments = (grid.blocked, grid.origin_enu_m, grid.resolution_m, grid.bounds_enu_m)

    def checkMotion(self, a: Any, b: Any) -> bool:  # noqa: N802
        """Return True if the straight motion from state a to state b is free."""
        free: bool = segment_free(*self._arguments, a[0], a[1], a[2], b[0], b[1], b[2])
        return free


def _run(problem: PlanningProblem, seed: int, search: _Search) -> PlanResult:
    """Search a path from start to goal. Return a straight line if that is free."""
    refused = refuse(problem)
    if refused is not None:
        return refused
    start, goal = problem.start_enu_m, problem.goal_enu_m
    if problem.grid.segment_free(start, goal):
        return PlanResult(found=True, path_enu_m=np.vstack([start, goal]))
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    ou.RNG.setSeed(seed % MAX_SEED + 1)
    space, information = _space(problem.grid)
    definition = ob.ProblemDefinition(information)
    definition.setStartAndGoalStates(_state(space, start), _state(space, goal), 1e-6)
    objective = ob.PathLengthOptimizationObjective(information)
    if not search.optimise:
        objective.setCostThreshold(ob.Cost(math.inf))
    definition.setOptimizationObjective(objective)
    planner = search.make(information)
    planner.setProblemDefinition(definition)
    planner.setup()
    counter = _Counter(search.iterations)
    planner.solve(ob.PlannerTerminationCondition(counter))
    return _result(problem, definition, counter.count)


class _Counter:
    """Stop condition that becomes true after `limit` calls."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.count = 0

    def __call__(self) -> bool:
        self.count += 1
        return self.count > self.limit


def _space(grid: ObstacleGrid) -> tuple[Any, Any]:
    space = ob.RealVectorStateSpace(3)
    bounds = ob.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(grid.bounds_enu_m[axis]))
        bounds.setHigh(axis, float(grid.bounds_enu_m[3 + axis]))
    space.setBounds(bounds)
    information = ob.SpaceInformation(space)
    arguments = (grid.blocked, grid.origin_enu_m, grid.resolution_m, grid.bounds_enu_m)

    def valid(state: Any) -> bool:
        """Return True if a state (east, north, up, m) lies in free space."""
        x, y, z = state[0], state[1], state[2]
        free: bool = segment_free(*arguments, x, y, z, x, y, z)
        return free

    information.setStateValidityChecker(valid)
    information.setMotionValidator(_GridMotions(information, grid))
    information.setup()
    return space, information


def _state(space: Any, point: FloatArray) -> Any:
    state = space.allocState()
    for axis in range(3):
        state[axis] = float(point[axis])
    return state


def _result(problem: PlanningProblem, definition: Any, iterations: int) -> PlanResult:
    if not definition.hasExactSolution():
        gap_m = math.dist(problem.goal_enu_m, problem.start_enu_m)
        if definition.hasApproximateSolution():
            gap_m = min(gap_m, float(definition.getSolutionDifference()))
        return PlanResult(
            found=False,
            path_enu_m=np.empty((0, 3)),
            reason=f"no path within {iterations} iterations",
            nearest_m=gap_m,
            iterations=iterations,
        )
    states = definition.getSolutionPath().getStates()
    path = np.array([[state[0], state[1], state[2]] for state in states])
    path[0], path[-1] = problem.start_enu_m, problem.goal_enu_m
    return PlanResult(found=True, path_enu_m=path, iterations=iterations)


@dataclass(frozen=True, slots=True, kw_only=True)
class RRT:
    """RRT with OMPL's default goal bias, and a shorter maximum step for dense maps."""

    name: ClassVar[str] = "rrt"

    iterations: int = 5000
    range_m: float = 10.0
    goal_bias: float = 0.05

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """See `Planner.plan`."""
        return _run(problem, seed, _Search(make=self._make, iterations=self.iterations))

    def _make(self, information: Any) -> Any:
        planner = og.RRT(information)
        planner.setRange(self.range_m)
        planner.setGoalBias(self.goal_bias)
        return planner


@dataclass(frozen=True, slots=True, kw_only=True)
class RRTConnect:
    """RRTConnect, which grows two trees towards each other."""

    name: ClassVar[str] = "rrtconnect"

    iterations: int = 5000
    range_m: float = 10.0

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """See `Planner.plan`."""
        return _run(problem, seed, _Search(make=self._make, iterations=self.iterations))

    def _make(self, information: Any) -> Any:
        planner = og.RRTConnect(information)
        planner.setRange(self.range_m)
        return planner


@dataclass(frozen=True, slots=True, kw_only=True)
class RRTStar:
    """RRT* with OMPL's default goal bias and rewiring factor.

    After the first solution it samples only states that could shorten the path (Gammell et al.
    2014). 300 iterations with this restriction give shorter paths than 500 without, at half the
    cost.

    If the iterations end without a solution, a second search takes shorter steps and up to
    `patience` iterations, and stops at its first solution. Only hard maps incur this cost.
    """

    name: ClassVar[str] = "rrtstar"

    iterations: int = 300
    range_m: float = 25.0
    patience: int = 2000
    patient_range_m: float = 5.0
    goal_bias: float = 0.05
    rewire_factor: float = 1.1

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """See `Planner.plan`."""
        best = _Search(
            make=lambda information: self._make(information, self.range_m),
            iterations=self.iterations,
            optimise=True,
        )
        result = _run(problem, seed, best)
        if result.found or result.iterations == 0:
            return result
        any_at_all = _Search(
            make=lambda information: self._make(information, self.patient_range_m),
            iterations=self.patience,
        )
        return _run(problem, seed, any_at_all)

    def _make(self, information: Any, range_m: float) -> Any:
        planner = og.RRTstar(information)
        planner.setRange(range_m)
        planner.setGoalBias(self.goal_bias)
        planner.setRewireFactor(self.rewire_factor)
        planner.setInformedSampling(True)
        return planner
