"""OMPL's planners: RRT* (Karaman and Frazzoli 2011), RRT (LaValle 1998), RRTConnect (Kuffner 2000).

OMPL's random generators take their seeds from a process-wide sequence when they are created. Each
search resets that sequence first and creates its generators afterwards, so its result depends on
problem and seed only. OMPL warns that earlier generators keep their seeds; none of them is used.
The search stops after a number of iterations, never after a time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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
    """One search of a planner."""

    iterations: int
    range_m: float  # longest step of the tree
    optimise: bool = False  # continue after the first solution until the iterations are used up


@dataclass(frozen=True, slots=True, kw_only=True)
class _OmplPlanner:
    """One of OMPL's planners. It searches again, as the next search says, while there is no path.

    A straight line from start to goal is the path if it is free.
    """

    name: str
    kind: Any  # class of `ompl.geometric`
    settings: Mapping[str, float]  # argument of each of its setters
    searches: tuple[_Search, ...]

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """See `Planner.plan`."""
        result = refuse(problem)
        if result is not None:
            return result
        start, goal = problem.start_enu_m, problem.goal_enu_m
        if problem.grid.segment_free(start, goal):
            return PlanResult(found=True, path_enu_m=np.vstack([start, goal]))
        for search in self.searches:
            result = self._search(problem, seed, search)
            if result.found:
                break
        assert result is not None
        return result

    def _search(self, problem: PlanningProblem, seed: int, search: _Search) -> PlanResult:
        ou.setLogLevel(ou.LogLevel.LOG_NONE)
        ou.RNG.setSeed(seed % MAX_SEED + 1)
        space, information = _space(problem.grid)
        definition = ob.ProblemDefinition(information)
        ends = [_state(space, point) for point in (problem.start_enu_m, problem.goal_enu_m)]
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
        asked = itertools.count(1)
        planner.solve(ob.PlannerTerminationCondition(lambda: next(asked) > search.iterations))
        return _result(problem, definition, next(asked) - 1)


class _GridMotions(ob.MotionValidator):  # type: ignore[misc]
    """Segment test on the obstacle grid. Holds no reference to OMPL objects."""

    def __init__(self, information: Any, grid: ObstacleGrid) -> None:
        super().__init__(information)
        self._arguments = (grid.blocked, grid.origin_enu_m, grid.resolution_m, grid.bounds_enu_m)

    def checkMotion(self, a: Any, b: Any) -> bool:  # noqa: N802
        """Return True if the straight motion from state a to state b is free."""
        free: bool = segment_free(*self._arguments, a[0], a[1], a[2], b[0], b[1], b[2])
        return free


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


_GOAL_BIAS = {"setGoalBias": 0.05}  # OMPL's default
_FIRST_SOLUTION = _Search(
    iterations=5000, range_m=10.0
)  # a shorter step than OMPL's, for dense maps

OMPL_PLANNERS = (
    # After the first solution, RRT* samples only states that could shorten the path (Gammell et al.
    # 2014). 300 iterations with this restriction give shorter paths than 500 without, at half the
    # cost. Only hard maps incur the cost of the second search.
    _OmplPlanner(
        name="rrtstar",
        kind=og.RRTstar,
        settings={**_GOAL_BIAS, "setRewireFactor": 1.1, "setInformedSampling": True},
        searches=(
            _Search(iterations=300, range_m=25.0, optimise=True),
            _Search(iterations=2000, range_m=5.0),
        ),
    ),
    _OmplPlanner(name="rrt", kind=og.RRT, settings=_GOAL_BIAS, searches=(_FIRST_SOLUTION,)),
    _OmplPlanner(name="rrtconnect", kind=og.RRTConnect, settings={}, searches=(_FIRST_SOLUTION,)),
)
