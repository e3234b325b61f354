"""Baseline detector `l2`: the norm of all deltas, each in units of its scale."""

from __future__ import annotations

import math
from typing import ClassVar

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray, Stage
from mavfi_cli.detect.base import FittedDetector, Shapes
from mavfi_cli.detect.preprocess import COUNT, Codes


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
