"""What our own detectors share: they come from a model file, and remember in one flat array.

One that is to be cheap judges a whole tick in one compiled call, and so a whole plan. A call costs
more than the arithmetic in it: in flight, where the caches hold other things, several times more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from mavfi_cli.core.types import FloatArray
from mavfi_cli.detect import model as model_file
from mavfi_cli.detect.base import StackMark
from mavfi_cli.detect.watch import Ranges

Shapes = dict[str, tuple[int, ...]]
# (memory, work, waypoints, row, velocity, yaw, keep_report) -> score, and whose it is.
TickJudge = Callable[..., tuple[float, int]]
# (memory, work, waypoints, first, steps, changes, scores) -> how many steps there are.
PlanJudge = Callable[..., int]
PASSED, OF_PLANNING, OF_CONTROL = range(3)  # which stage's score is above the threshold


class FittedDetector:
    """A detector whose memory is one flat array, so that compiled code takes a single argument.

    Attributes:
        shapes: names and shapes of the pieces of the memory, in their order; the first one, a
            single number, is the threshold.
        divisors: pieces besides the threshold of which every number must be above 0.
        scratch: numbers that compiled code wants for itself, after the pieces.
        stack: that of the flights which the model was fitted to; None without a model file.
        extended: ranges of the extended states in these flights; None without a model file.
        tick_judge: `preprocess.take_tick`, then score and learn as the gate does, in one call.
        plan_judge: `preprocess.plan_deltas`, and the score of each step that it finds.
    """

    name: ClassVar[str]
    shapes: ClassVar[Shapes]
    divisors: ClassVar[tuple[str, ...]] = ()
    scratch: ClassVar[int] = 0
    tick_judge: ClassVar[TickJudge | None] = None
    plan_judge: ClassVar[PlanJudge | None] = None

    def __init__(self, arrays: Mapping[str, FloatArray]) -> None:
        pieces = [np.asarray(arrays[name], np.float64).ravel() for name in self.shapes]
        self._flat: FloatArray = np.concatenate([*pieces, np.zeros(self.scratch)])
        self.stack: StackMark | None = None
        self.extended: Ranges | None = None
        self._views()

    def _views(self) -> None:
        self._memory: dict[str, FloatArray] = {}
        start = 0
        for name, shape in self.shapes.items():
            end = start + math.prod(shape)
            self._memory[name] = self._flat[start:end].reshape(shape)
            start = end

    @property
    def memory(self) -> Mapping[str, FloatArray]:
        """Views of all that decides; a change takes effect with the next sample."""
        return self._memory

    @property
    def flat(self) -> FloatArray:
        """All of the memory in one array, as compiled code takes it."""
        return self._flat

    @property
    def threshold(self) -> float:
        """A score above it is an alarm."""
        threshold: float = self._flat.item(0)
        return threshold

    @classmethod
    def build(cls, *, model: Path | None = None, threshold: float | None = None) -> Self:
        """The detector of a model file; None takes that shipped for the default stack.

        See `base.Factory`.
        """
        path = model_file.shipped(cls.name) if model is None else model
        positive = (next(iter(cls.shapes)), *cls.divisors)
        loaded = model_file.load(path, cls.name, cls.shapes, positive)
        detector = cls(loaded.arrays)
        detector.stack, detector.extended = loaded.stack, loaded.extended
        if threshold is not None:
            detector._flat[0] = model_file.checked_threshold(threshold)
        return detector

    def __getstate__(self) -> dict[str, Any]:
        return {"flat": self._flat, "stack": self.stack, "extended": self.extended}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._flat, self.stack, self.extended = state["flat"], state["stack"], state["extended"]
        self._views()
