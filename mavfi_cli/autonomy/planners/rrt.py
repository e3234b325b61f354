"""RRT (LaValle 1998) from OMPL. Stops at the first solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from ompl import geometric as og

from mavfi_cli.autonomy.planners.base import PlanningProblem, PlanResult
from mavfi_cli.autonomy.planners.search import Search, run


@dataclass(frozen=True, slots=True, kw_only=True)
class RRT:
    """RRT with OMPL's default goal bias, and a shorter maximum step for dense maps."""

    name: ClassVar[str] = "rrt"

    iterations: int = 5000
    range_m: float = 10.0
    goal_bias: float = 0.05

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """See `Planner.plan`."""
        return run(problem, seed, Search(make=self._make, iterations=self.iterations))

    def _make(self, information: Any) -> Any:
        planner = og.RRT(information)
        planner.setRange(self.range_m)
        planner.setGoalBias(self.goal_bias)
        return planner
