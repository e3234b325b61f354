"""Preprocessing of states: sign and exponent as an integer code, then its change over time.

Paper, section V-B. The code of a float64 with sign s and binary exponent e (0 for 1.5, 1 for 2.0)
is its signed log-magnitude above a floor,

    code = (-1)^s max(0, min(e, ceiling) - floor),

so that every magnitude below 2^(floor + 1) has the code 0, and a zero crossing does not look like a
fault. The mantissa is ignored. The code of an integer is the integer itself, saturated. NaN has a
code of its own, far from all others. An infinity has the exponent 1024, or the ceiling if there is
one, so that an infinite `time_to_collision` and a merely long one have the same code.

The delta is the difference between the codes of a sample and of the last accepted sample of the
same state, saturated to 16 bits. It is 0 if there is no such sample. Yaw wraps: a change from above
2 rad to below -2 rad, or back, counts as no change.

docs/results/detectors.md compares this code with other combinations of sign and exponent.

The extended states are `collision` of a report, and `plan_trajectory_seq` and
`plan_future_collision_seq` of a plan. Their codes are their integer values.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import BY_NAME, STATES, DType, FloatArray, Message, Stage, State

Codes = NDArray[np.int16]
IntArray = NDArray[np.int64]

DETECTED: tuple[State, ...] = tuple(state for state in STATES if state.detected)
NAMES: tuple[str, ...] = tuple(state.name for state in DETECTED)
COUNT = len(DETECTED)

EXTENDED = tuple(
    BY_NAME[name] for name in ("collision", "plan_trajectory_seq", "plan_future_collision_seq")
)
Ranges = dict[str, tuple[int, int]]  # name of an extended state -> smallest and largest change

LIMIT = 32767  # maximum of a code and of a delta
UNKNOWN = -32768  # reference of a state without an accepted sample
NAN_CODE = 16384

_MANTISSA_BITS, _EXPONENT_MASK, _BIAS = 52, 0x7FF, 1023  # layout of a float64

# Rows of the working array.
REFERENCE, PREVIOUS, CODE, DELTA, FLOOR, CEILING, KIND = range(7)
ROWS = 7
_REAL, _INTEGER, _ANGLE = range(3)


def _span(stage: Stage) -> tuple[int, int]:
    places = [index for index, state in enumerate(DETECTED) if state.stage is stage]
    assert places == list(range(places[0], places[-1] + 1)), "a stage's states are neighbours"
    return places[0], places[-1] + 1


# First index, and index after the last, of each stage among the detected states.
SPANS: dict[Stage, tuple[int, int]] = {stage: _span(stage) for stage in Stage}
_PERCEPTION_STAGE, _PLANNING_STAGE = Stage.PERCEPTION, Stage.PLANNING
_PLANNING, _CONTROL = SPANS[Stage.PLANNING][0], SPANS[Stage.CONTROL][0]


def span(stage: Stage) -> tuple[int, int]:
    """Return the first index of a stage among the detected states, and the index after its last.

    The result equals `SPANS[stage]`, but needs no dictionary.
    """
    if stage is _PLANNING_STAGE:
        return _PLANNING, _CONTROL
    return (0, _PLANNING) if stage is _PERCEPTION_STAGE else (_CONTROL, COUNT)


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


# SHA-256 of names, stages, types and units of the detected states in order.
STATES_DIGEST = _digest([[s.name, s.stage.value, s.dtype.value, s.unit] for s in DETECTED])


@dataclass(frozen=True, slots=True, kw_only=True)
class PreprocessParams:
    """The floor exponent of each group of states, and the ceiling exponent of `time_to_collision`.

    A floor is close to the largest change between two samples in error-free flight: 1.5 m between
    waypoints, 0.1 m/s between commands 20 ms apart. A command changes by more only at the start or
    end of a plan.
    """

    time_to_collision_floor: int = 0
    time_to_collision_ceiling: int = 4
    position_floor: int = 0
    yaw_floor: int = -1
    velocity_floor: int = 0
    command_velocity_floor: int = -3
    command_yaw_floor: int = -4

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not -1022 <= value <= 1023:
                raise ConfigError(f"must be between -1022 and 1023, got {value}", key=name)
        floor, ceiling = self.time_to_collision_floor, self.time_to_collision_ceiling
        if ceiling <= floor:
            problem = f"must be above the floor {floor}, got {ceiling}"
            raise ConfigError(problem, key="time_to_collision_ceiling")

    def working_array(self) -> Codes:
        """Create the working array (ROWS, COUNT) that the functions of this module read and write.

        No state has a reference yet. Row REFERENCE holds the reference codes of the deltas,
        PREVIOUS the reference codes before the last sample, CODE and DELTA the codes and deltas of
        the last sample. FLOOR, CEILING and KIND define the encoding.
        """
        columns = []
        for state in DETECTED:
            if state.dtype is not DType.FLOAT64:
                columns.append((0, LIMIT, _INTEGER))
                continue
            endless = state.name == "time_to_collision"
            ceiling = self.time_to_collision_ceiling if endless else LIMIT
            kind = _ANGLE if state.unit == "rad" else _REAL
            floor = getattr(self, f"{state.group.removeprefix('waypoint_')}_floor")
            columns.append((floor, ceiling, kind))
        work = np.zeros((ROWS, COUNT), np.int16)
        work[REFERENCE : PREVIOUS + 1] = UNKNOWN
        work[FLOOR:] = np.array(columns, np.int16).T
        return work

    def digest(self) -> str:
        """Return the SHA-256 of the parameters and of the coding's name, as hexadecimal text."""
        return _digest({"coding": "signed log-magnitude", **asdict(self)})


def extended_codes(message: Message) -> list[tuple[int, int]]:
    """Return, for each extended state in a message, its index in EXTENDED and its code."""
    return [
        (place, min(max(int(state.read(message, 0)), -LIMIT), LIMIT))
        for place, state in enumerate(EXTENDED)
        if isinstance(message, state.message)
    ]


@compiled
def _encode(value: float, floor: int, ceiling: int, kind: int) -> int:
    if math.isnan(value):
        return NAN_CODE
    if kind == _INTEGER:
        return int(min(max(value, -LIMIT), LIMIT))
    pattern = np.float64(value).view(np.int64)
    exponent = int(pattern >> _MANTISSA_BITS & _EXPONENT_MASK) - _BIAS  # 1024 for infinity
    magnitude = max(0, min(exponent, ceiling) - floor)  # 0 for zero and subnormals
    return -magnitude if value < 0.0 else magnitude


@compiled
def _take(work: Codes, place: int, value: float) -> None:
    """Encode a new sample of the state at index `place`, and make it the state's reference."""
    floor, kind = work[FLOOR, place], work[KIND, place]
    code = _encode(value, floor, work[CEILING, place], kind)
    before = work[REFERENCE, place]
    work[DELTA, place] = _difference(before, code, floor, kind)
    work[PREVIOUS, place] = before
    work[CODE, place] = code
    work[REFERENCE, place] = code


@compiled
def _difference(before: int, code: int, floor: int, kind: int) -> int:
    """Return the delta between two codes, saturated to 16 bits.

    The delta is 0 if there is no reference code, or if a yaw has wrapped.
    """
    if before == UNKNOWN:
        return 0
    if kind == _ANGLE:
        top = 1 - floor  # code of angles from 2 to 4 rad
        if top > 0 and abs(code) == top and before == -code:
            return 0
    return min(max(code - before, -LIMIT), LIMIT)


@compiled
def take_report(time_to_collision_s: float, future_collision_seq: float, work: Codes) -> None:
    """Write the deltas of a collision report to `work`, and set those of other stages to 0."""
    _take(work, 0, time_to_collision_s)
    _take(work, 1, future_collision_seq)
    work[DELTA, _PLANNING:] = 0


@compiled
def take_tick(
    waypoints: FloatArray,
    index: int,
    velocity_enu_mps: FloatArray,
    yaw_rad: float,
    keep_report: bool,
    work: Codes,
) -> None:
    """Write the deltas of a control tick to `work`: those of its waypoint and of its command.

    The waypoint is row `index` of `waypoints` (n, 10). A negative `index` means that no waypoint is
    new, so the planning deltas become 0. The deltas of the last report stay if `keep_report` is
    set, and become 0 otherwise.
    """
    if not keep_report:
        work[DELTA, :_PLANNING] = 0
    if index >= 0:
        for column in range(_CONTROL - _PLANNING):
            _take(work, _PLANNING + column, waypoints[index, column])
    else:
        work[DELTA, _PLANNING:_CONTROL] = 0
    for axis in range(3):
        _take(work, _CONTROL + axis, velocity_enu_mps[axis])
    _take(work, _CONTROL + 3, yaw_rad)


@compiled
def plan_deltas(waypoints: FloatArray, first: int, work: Codes, steps: IntArray, out: Codes) -> int:
    """Compute the nonzero deltas between consecutive waypoints (n, 10), starting at `first`.

    Step k leads from waypoint k to k + 1. Steps with a changed code are written to `steps` (n,) and
    their deltas to `out` (n, COUNT). `work` does not change.

    Returns:
        The number of steps that were written.
    """
    count = 0
    columns = _CONTROL - _PLANNING
    codes = np.empty(columns, np.int64)
    for row in range(max(first, 0), waypoints.shape[0]):
        begins = row == max(first, 0)
        changed = False
        for column in range(columns):
            place = _PLANNING + column
            floor, kind = work[FLOOR, place], work[KIND, place]
            code = _encode(waypoints[row, column], floor, work[CEILING, place], kind)
            if not begins:
                delta = _difference(codes[column], code, floor, kind)
                out[count, place] = delta
                changed = changed or delta != 0
            codes[column] = code
        if changed:
            out[count, :_PLANNING] = 0
            out[count, _CONTROL:] = 0
            steps[count] = row - 1
            count += 1
    return count
