"""AAD: one autoencoder over all stages (paper, section V-D). Inference does not need torch.

    13 inputs -> 6 tanh -> 3 tanh -> 13 linear outputs,    error = mean (out - in)^2.

Each delta is divided by its scale, so the network's inputs and outputs lie between about -1 and 1.
An error above the largest one in error-free flights raises an alarm.
"""

from __future__ import annotations

import math
from typing import ClassVar

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray, Stage
from mavfi_cli.detect.base import OF_CONTROL, PASSED, FittedDetector, Shapes
from mavfi_cli.detect.preprocess import COUNT, DELTA, Codes, IntArray, plan_deltas, take_tick

HIDDEN, CODED = 6, 3
WEIGHTS: Shapes = {
    "hidden_weights": (HIDDEN, COUNT),
    "hidden_biases": (HIDDEN,),
    "coded_weights": (CODED, HIDDEN),
    "coded_biases": (CODED,),
    "output_weights": (COUNT, CODED),
    "output_biases": (COUNT,),
}

# Offsets in the flat array.
_SCALE = 1
_W1 = _SCALE + COUNT
_B1 = _W1 + HIDDEN * COUNT
_W2 = _B1 + HIDDEN
_B2 = _W2 + CODED * HIDDEN
_W3 = _B2 + CODED
_B3 = _W3 + COUNT * CODED
_WORK = _B3 + COUNT


@compiled
def _reconstruction_error(memory: FloatArray, deltas: Codes) -> float:
    """Return the mean squared reconstruction error of the scaled deltas.

    `memory[_WORK:]` is scratch space.
    """
    work = memory[_WORK:]
    for place in range(COUNT):
        work[place] = deltas[place] / memory[_SCALE + place]
    for unit in range(HIDDEN):
        total = memory[_B1 + unit]
        for place in range(COUNT):
            total += memory[_W1 + unit * COUNT + place] * work[place]
        work[COUNT + unit] = math.tanh(total)
    for unit in range(CODED):
        total = memory[_B2 + unit]
        for place in range(HIDDEN):
            total += memory[_W2 + unit * HIDDEN + place] * work[COUNT + place]
        work[COUNT + HIDDEN + unit] = math.tanh(total)
    error = 0.0
    for place in range(COUNT):
        total = memory[_B3 + place]
        for unit in range(CODED):
            total += memory[_W3 + place * CODED + unit] * work[COUNT + HIDDEN + unit]
        error += (total - work[place]) * (total - work[place])
    return error / COUNT


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
    """Score the deltas of a control tick; see `FittedDetector.tick_judge`."""
    take_tick(waypoints, row, velocity_enu_mps, yaw_rad, keep_report, work)
    error = _reconstruction_error(memory, work[DELTA])
    return error, PASSED if error <= memory[0] else OF_CONTROL


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
        scores[number] = _reconstruction_error(memory, changes[number])
    return count


class AutoencoderDetector(FittedDetector):
    """Detector whose score is the reconstruction error of an autoencoder.

    Weight matrices have shape (outputs, inputs).
    """

    name: ClassVar[str] = "aad"
    per_stage = False
    scratch: ClassVar[int] = COUNT + HIDDEN + CODED
    shapes: ClassVar[Shapes] = {"threshold": (1,), "scale": (COUNT,), **WEIGHTS}
    divisors: ClassVar[tuple[str, ...]] = ("scale",)
    tick_judge = staticmethod(_judge_tick)
    plan_judge = staticmethod(_judge_plan)

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the mean squared reconstruction error of the 13 scaled deltas."""
        return _reconstruction_error(self.flat, deltas)
