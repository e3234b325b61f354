"""The plan of a campaign on native code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mavfi_cli.attack.target import AttackTarget
from mavfi_cli.fi.tracer.fault import FaultModel
from mavfi_cli.fi.tracer.sampling import Rule, Strategy, strategy


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Which faults are drawn; `runs` is the number of runs of each target."""

    runs: int
    seed: int
    rule: str = Rule.INSTRUCTION.value
    compat: str | None = None
    model: FaultModel | None = None
    windows: int = 16  # number of stepped windows, if not the whole run is stepped
    null: bool = False  # everything but the flip

    def strategy(self) -> Strategy:
        """The sampling strategy."""
        return strategy(self.rule, self.model, compat=self.compat)

    def to_json(self, target: AttackTarget) -> dict[str, Any]:
        """The entries that results depend on, without number of runs and choice of targets."""
        return {
            "seed": self.seed,
            "rule": self.rule,
            "compat": self.compat,
            "windows": self.windows,
            "null": self.null,
            "model": self.strategy().model.to_json(),
            **target.known(),
        }
