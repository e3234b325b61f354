"""GAD: one online Gaussian model per state, with alarms per stage (paper, section V-C).

Mean and sum of squares follow equations 1 and 2, with M_1 = x_1 and S_1 = 0:

    M_k = M_{k-1} + (x_k - M_{k-1}) / k
    S_k = S_{k-1} + (x_k - M_{k-1}) (x_k - M_k),        sigma = sqrt(S_k / (k - 1)).

The score of a stage is the largest |x - M| / sigma of its states, and its threshold is `n_sigma`.
Codes are integers, and a state that rarely changes would have a sigma close to 0, so sigma is never
below the `sigma_floor` of its stage. With fewer than two samples, sigma is this floor.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray, Stage
from mavfi_cli.detect.base import OF_CONTROL, OF_PLANNING, PASSED, FittedDetector, Shapes
from mavfi_cli.detect.preprocess import (
    COUNT,
    DELTA,
    SPANS,
    Codes,
    IntArray,
    plan_deltas,
    span,
    take_tick,
)

N_SIGMA = 5.0
# In codes. Commands are 25 times as frequent as waypoints and change less between samples.
SIGMA_FLOORS = {Stage.PERCEPTION: 0.3, Stage.PLANNING: 0.3, Stage.CONTROL: 0.5}
_FLOOR = 1  # offset in the flat array
_COUNT = _FLOOR + COUNT
_MEAN = _COUNT + COUNT
_SUM = _MEAN + COUNT
_PLANNING, _CONTROL = SPANS[Stage.PLANNING]


@compiled
def _farthest(memory: FloatArray, deltas: Codes, first: int, end: int) -> float:
    """Return the largest distance of a delta from its mean, in sigmas.

    Only states from `first` up to but not including `end` count. The result is NaN if the model of
    one of them is corrupted.
    """
    worst = 0.0
    for place in range(first, end):
        count = memory[_COUNT + place]
        sigma = memory[_FLOOR + place]
        if not count < 2.0:
            spread = math.sqrt(memory[_SUM + place] / (count - 1.0))
            if not spread < sigma:
                sigma = spread
        distance = abs(deltas[place] - memory[_MEAN + place]) / sigma
        if not distance <= worst:
            worst = distance
        if math.isnan(worst):
            return worst
    return worst


@compiled
def _welford(memory: FloatArray, deltas: Codes, first: int, end: int) -> None:
    """Add one sample to the model of each state from `first` up to but not including `end`."""
    for place in range(first, end):
        value = float(deltas[place])
        count = memory[_COUNT + place] + 1.0
        mean = memory[_MEAN + place]
        updated = value if count == 1.0 else mean + (value - mean) / count
        if count > 1.0:
            memory[_SUM + place] += (value - mean) * (value - updated)
        memory[_COUNT + place] = count
        memory[_MEAN + place] = updated


@compiled
def _judge_tick(
    memory: FloatArray,
    work: Codes,
    waypoints: FloatArray,
    row: int,
    velocity_enu_mps: FloatArray,
    yaw_rad: float,
    keep_report: bool,
) -> tuple[float, int]:
    """Score the deltas of a control tick stage by stage, and learn from them if they pass.

    See `FittedDetector.tick_judge`.
    """
    take_tick(waypoints, row, velocity_enu_mps, yaw_rad, keep_report, work)
    deltas = work[DELTA]
    if row >= 0:
        score = _farthest(memory, deltas, _PLANNING, _CONTROL)
        if not score <= memory[0]:
            return score, OF_PLANNING
        _welford(memory, deltas, _PLANNING, _CONTROL)
    score = _farthest(memory, deltas, _CONTROL, COUNT)
    if not score <= memory[0]:
        return score, OF_CONTROL
    _welford(memory, deltas, _CONTROL, COUNT)
    return score, PASSED


@compiled
def _judge_plan(
    memory: FloatArray,
    work: Codes,
    waypoints: FloatArray,
    first: int,
    steps: IntArray,
    changes: Codes,
    scores: FloatArray,
) -> int:
    """Score the steps of a plan, and return their number; see `FittedDetector.plan_judge`."""
    count = plan_deltas(waypoints, first, work, steps, changes)
    for number in range(count):
        scores[number] = _farthest(memory, changes[number], _PLANNING, _CONTROL)
    return count


class GaussianDetector(FittedDetector):
    """Detector with an online Gaussian model of the deltas of each state."""

    name: ClassVar[str] = "gad"
    per_stage = True
    shapes: ClassVar[Shapes] = {
        "n_sigma": (1,),
        "sigma_floor": (COUNT,),
        "count": (COUNT,),
        "mean": (COUNT,),
        "sum_of_squares": (COUNT,),
    }
    divisors: ClassVar[tuple[str, ...]] = ("sigma_floor",)
    tick_judge = staticmethod(_judge_tick)
    plan_judge = staticmethod(_judge_plan)

    @classmethod
    def cold(cls, n_sigma: float = N_SIGMA) -> GaussianDetector:
        """Create a detector that has not learned from any sample yet."""
        arrays = {name: np.zeros(shape) for name, shape in cls.shapes.items()}
        arrays["n_sigma"][0] = n_sigma
        for stage, floor in SIGMA_FLOORS.items():
            arrays["sigma_floor"][slice(*span(stage))] = floor
        return cls(arrays)

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the distance of the stage's most anomalous delta from its mean, in sigmas."""
        first, end = span(stage)
        return _farthest(self.flat, deltas, first, end)

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Update the mean and the sum of squares of each state of the stage (equations 1 and 2)."""
        first, end = span(stage)
        _welford(self.flat, deltas, first, end)
