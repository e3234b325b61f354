"""Base of our own detectors, which load a model file and keep their state in one flat array.

A cheap detector scores a whole tick, or a whole plan, in one compiled call. The call overhead is
larger than the arithmetic, and several times larger in flight, where caches hold other data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from mavfi_cli.core.types import FloatArray, StackMark, Stage
from mavfi_cli.detect import model as model_file
from mavfi_cli.detect.preprocess import Codes
from mavfi_cli.detect.watch import Ranges

Shapes = dict[str, tuple[int, ...]]
# (memory, work, waypoints, row, velocity, yaw, keep_report) -> score and its stage.
TickJudge = Callable[..., tuple[float, int]]
# (memory, work, waypoints, first, steps, changes, scores) -> number of steps.
PlanJudge = Callable[..., int]
PASSED, OF_PLANNING, OF_CONTROL = range(3)  # stage with a score above the threshold


class FittedDetector:
    """A detector with its state in one flat array, which compiled code takes as one argument.

    Attributes:
        flat: All of the memory as one array, the argument of compiled code.
        shapes: Names and shapes of the parts of the memory, in their order. The first part is the
            threshold, a single number.
        divisors: Parts, besides the threshold, whose numbers must all be above 0.
        scratch: Number of scratch elements for compiled code after the parts.
        stack: Stack of the flights that the model was fitted to; None without a model file.
        extended: Ranges of the extended states in these flights; None without a model file.
        tick_judge: `preprocess.take_tick` followed by scoring and learning as in the gate.
        plan_judge: `preprocess.plan_deltas` and the score of each step that it finds.
    """

    name: ClassVar[str]
    shapes: ClassVar[Shapes]
    divisors: ClassVar[tuple[str, ...]] = ()
    scratch: ClassVar[int] = 0
    tick_judge: ClassVar[TickJudge | None] = None
    plan_judge: ClassVar[PlanJudge | None] = None

    def __init__(self, arrays: Mapping[str, FloatArray]) -> None:
        pieces = [np.asarray(arrays[name], np.float64).ravel() for name in self.shapes]
        self.flat: FloatArray = np.concatenate([*pieces, np.zeros(self.scratch)])
        self.stack: StackMark | None = None
        self.extended: Ranges | None = None
        self._views()

    def _views(self) -> None:
        self._memory: dict[str, FloatArray] = {}
        start = 0
        for name, shape in self.shapes.items():
            end = start + math.prod(shape)
            self._memory[name] = self.flat[start:end].reshape(shape)
            start = end

    @property
    def memory(self) -> Mapping[str, FloatArray]:
        """Writable views of the detector's state. A change takes effect at the next sample."""
        return self._memory

    @property
    def threshold(self) -> float:
        """Threshold. A score above it raises an alarm."""
        threshold: float = self.flat.item(0)
        return threshold

    @classmethod
    def build(cls, *, model: Path | None = None, threshold: float | None = None) -> Self:
        """Create the detector of a model file; None selects the one for the default stack.

        See `base.find_detector`.
        """
        path = model_file.shipped(cls.name) if model is None else model
        positive = (next(iter(cls.shapes)), *cls.divisors)
        loaded = model_file.Model.load(path, cls.name, cls.shapes, positive)
        detector = cls(loaded.arrays)
        detector.stack, detector.extended = loaded.stack, loaded.extended
        if threshold is not None:
            detector.flat[0] = model_file.checked_threshold(threshold)
        return detector

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Do nothing, because most models are fixed in flight. See `base.Detector`."""

    def __getstate__(self) -> dict[str, Any]:
        return {"flat": self.flat, "stack": self.stack, "extended": self.extended}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.flat, self.stack, self.extended = state["flat"], state["stack"], state["extended"]
        self._views()
