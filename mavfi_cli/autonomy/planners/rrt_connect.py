"""RRTConnect (Kuffner and LaValle 2000) from OMPL. Stops at the first solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from ompl import geometric as og

from mavfi_cli.autonomy.planners.base import PlanningProblem, PlanResult
from mavfi_cli.autonomy.planners.search import Search, run


@dataclass(frozen=True, slots=True, kw_only=True)
class RRTConnect:
    """RRTConnect, which grows two trees towards each other."""

    name: ClassVar[str] = "rrtconnect"

    iterations: int = 5000
    range_m: float = 10.0

    def plan(self, problem: PlanningProblem, seed: int) -> PlanResult:
        """See `Planner.plan`."""
        return run(problem, seed, Search(make=self._make, iterations=self.iterations))

    def _make(self, information: Any) -> Any:
        planner = og.RRTConnect(information)
        planner.setRange(self.range_m)
        return planner
