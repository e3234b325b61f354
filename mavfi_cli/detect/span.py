"""Baseline `range`: each state's delta must lie within what error-free flights have shown."""

from __future__ import annotations

import math
from typing import ClassVar

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray, Stage
from mavfi_cli.detect.fitted import FittedDetector, Shapes
from mavfi_cli.detect.preprocess import COUNT, Codes, span

MARGIN = 0.5  # codes are integers: the first one outside counts, rounding does not


class RangeDetector(FittedDetector):
    """The score is how far outside its range the stage's worst delta is, in codes; 0 inside."""

    name: ClassVar[str] = "range"
    per_stage = True
    shapes: ClassVar[Shapes] = {"margin": (1,), "lowest": (COUNT,), "highest": (COUNT,)}

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Distance from the range, in codes."""
        first, end = span(stage)
        distance: float = outside(self._flat, deltas, first, end)
        return distance

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Nothing: the ranges are fixed."""


@compiled
def outside(memory: FloatArray, deltas: Codes, first: int, end: int) -> float:
    """Largest distance of a delta from its range; NaN where a range is broken."""
    worst = 0.0
    for place in range(first, end):
        below = memory[1 + place] - deltas[place]
        above = deltas[place] - memory[1 + COUNT + place]
        if below != below or above != above:
            return math.nan
        worst = max(worst, below, above)
    return worst
