"""Baseline detectors: `range` and `l2`.

`range` asks whether each delta lies within its range in error-free flights, `l2` for the norm of
all deltas, each in units of its scale.
"""

from __future__ import annotations

import math
from typing import ClassVar

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray, Stage
from mavfi_cli.detect.base import FittedDetector, Shapes
from mavfi_cli.detect.preprocess import COUNT, Codes, span

MARGIN = 0.5  # codes are integers, so the first code outside the range exceeds this


class RangeDetector(FittedDetector):
    """Detector whose score is the largest distance of a delta from its range, in codes."""

    name: ClassVar[str] = "range"
    per_stage = True
    shapes: ClassVar[Shapes] = {"margin": (1,), "lowest": (COUNT,), "highest": (COUNT,)}

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the largest distance of the stage's deltas from their ranges, in codes."""
        first, end = span(stage)
        return _outside(self.flat, deltas, first, end)


@compiled
def _outside(memory: FloatArray, deltas: Codes, first: int, end: int) -> float:
    """Return the largest distance of a delta from its range.

    The distance is 0 inside the range. The result is NaN if a range contains NaN.
    """
    worst = 0.0
    for place in range(first, end):
        below = memory[1 + place] - deltas[place]
        above = deltas[place] - memory[1 + COUNT + place]
        if below != below or above != above:
            return math.nan
        worst = max(worst, below, above)
    return worst


class NormDetector(FittedDetector):
    """Detector whose score is the Euclidean norm of the scaled deltas."""

    name: ClassVar[str] = "l2"
    per_stage = False
    shapes: ClassVar[Shapes] = {"threshold": (1,), "scale": (COUNT,)}
    divisors: ClassVar[tuple[str, ...]] = ("scale",)

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the Euclidean norm of all deltas, each divided by its scale."""
        return _norm(self.flat, deltas)


@compiled
def _norm(memory: FloatArray, deltas: Codes) -> float:
    total = 0.0
    for place in range(COUNT):
        scaled = deltas[place] / memory[1 + place]
        total += scaled * scaled
    return math.sqrt(total)
