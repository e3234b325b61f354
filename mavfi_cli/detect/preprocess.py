"""From states to what a detector sees: sign and exponent as an integer, then its delta in time.

Paper, section V-B. The code of a float64 with sign s and binary exponent e (of 1.5 it is 0, of 2.0
it is 1) is its signed log-magnitude above a floor,

    code = (-1)^s max(0, min(e, ceiling) - floor),

so that everything below 2^(floor + 1) has the code 0 and a value that passes through zero does not
look like a fault. Only sign and exponent decide; the mantissa is not read. An integer is its own
code, saturated. A NaN has a code of its own, far from all others. An infinity has the exponent
1024, and that of the ceiling where there is one: a `time_to_collision` that is endless and one
that is merely long are the same news.

The delta is the difference between a sample's code and that of the last accepted sample of the
same state, saturated to 16 bits; 0 where there is no such sample. Yaw wraps: from beyond 2 rad to
below -2 rad, or back, counts as no change.

Why this and not another way to join sign and exponent: docs/detect.md, with measurements.
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
from mavfi_cli.core.states import STATES, DType, State
from mavfi_cli.core.types import FloatArray, Stage

Codes = NDArray[np.int16]
IntArray = NDArray[np.int64]

DETECTED: tuple[State, ...] = tuple(state for state in STATES if state.detected)
NAMES: tuple[str, ...] = tuple(state.name for state in DETECTED)
COUNT = len(DETECTED)

LIMIT = 32767  # of a code and of a delta
UNKNOWN = -32768  # reference of a state of which no sample was accepted yet
NAN_CODE = 16384

_MANTISSA_BITS, _EXPONENT_MASK, _BIAS = 52, 0x7FF, 1023  # of a float64

# Rows of the working array.
REFERENCE, PREVIOUS, CODE, DELTA, FLOOR, CEILING, KIND = range(7)
ROWS = 7
_REAL, _INTEGER, _ANGLE = range(3)


def _span(stage: Stage) -> tuple[int, int]:
    places = [index for index, state in enumerate(DETECTED) if state.stage is stage]
    assert places == list(range(places[0], places[-1] + 1)), "a stage's states are neighbours"
    return places[0], places[-1] + 1


# First and one past last place of each stage among the detected states.
SPANS: dict[Stage, tuple[int, int]] = {stage: _span(stage) for stage in Stage}
_PERCEPTION_STAGE, _PLANNING_STAGE = Stage.PERCEPTION, Stage.PLANNING
_PLANNING, _CONTROL = SPANS[Stage.PLANNING][0], SPANS[Stage.CONTROL][0]


def span(stage: Stage) -> tuple[int, int]:
    """First and one past last place of a stage; quicker than the table, for use in every tick."""
    if stage is _PLANNING_STAGE:
        return _PLANNING, _CONTROL
    return (0, _PLANNING) if stage is _PERCEPTION_STAGE else (_CONTROL, COUNT)


@dataclass(frozen=True, slots=True, kw_only=True)
class PreprocessParams:
    """Exponents that count as zero, by group of states, and the ceiling of the only endless one.

    A floor is about the largest change between two samples of the group in fault-free flight: a
    waypoint is at most 1.5 m from the next, a command 0.1 m/s from the one 20 ms before. A command
    changes by more only where a plan begins or ends.
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
                raise ConfigError(f"an exponent of a float64 lies in -1022..1023, got {value}",
                                  key=name)  # fmt: skip
        if self.time_to_collision_ceiling <= self.time_to_collision_floor:
            raise ConfigError("must be above the floor", key="time_to_collision_ceiling")

    def table(self) -> Codes:
        """Floor, ceiling and kind of each detected state, (3, COUNT)."""
        floors = {
            "time_to_collision": self.time_to_collision_floor,
            "waypoint_position": self.position_floor,
            "waypoint_yaw": self.yaw_floor,
            "waypoint_velocity": self.velocity_floor,
            "command_velocity": self.command_velocity_floor,
            "command_yaw": self.command_yaw_floor,
        }
        columns = []
        for state in DETECTED:
            if state.dtype is not DType.FLOAT64:
                columns.append((0, LIMIT, _INTEGER))
                continue
            endless = state.name == "time_to_collision"
            ceiling = self.time_to_collision_ceiling if endless else LIMIT
            kind = _ANGLE if state.unit == "rad" else _REAL
            columns.append((floors[state.group], ceiling, kind))
        return np.array(columns, np.int16).T.copy()

    def digest(self) -> str:
        """SHA-256 of the parameters and of the way they are used."""
        return _digest({"coding": "signed log-magnitude", **asdict(self)})


def states_digest() -> str:
    """SHA-256 of the detected states: names, stages, types, units, in their order."""
    return _digest([[s.name, s.stage.value, s.dtype.value, s.unit] for s in DETECTED])


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def working_array(params: PreprocessParams) -> Codes:
    """The array (ROWS, COUNT) that the functions below work on; no reference is known yet.

    REFERENCE holds the codes that deltas are taken against, PREVIOUS those before the last
    sample, CODE and DELTA the last sample's own; FLOOR, CEILING and KIND say how to encode.
    """
    work = np.zeros((ROWS, COUNT), np.int16)
    work[REFERENCE : PREVIOUS + 1] = UNKNOWN
    work[FLOOR:] = params.table()
    return work


@compiled
def encode(value: float, floor: int, ceiling: int, kind: int) -> int:
    """Code of one value."""
    if math.isnan(value):
        return NAN_CODE
    if kind == _INTEGER:
        return int(min(max(value, -LIMIT), LIMIT))
    pattern = np.float64(value).view(np.int64)
    exponent = int(pattern >> _MANTISSA_BITS & _EXPONENT_MASK) - _BIAS  # 1024 for an infinity
    magnitude = max(0, min(exponent, ceiling) - floor)  # of 0 and subnormals 0, under any floor
    return -magnitude if value < 0.0 else magnitude


@compiled
def take(work: Codes, place: int, value: float) -> None:
    """Encode a new sample of the state at that place, and let it be the reference."""
    floor, kind = work[FLOOR, place], work[KIND, place]
    code = encode(value, floor, work[CEILING, place], kind)
    before = work[REFERENCE, place]
    work[DELTA, place] = difference(before, code, floor, kind)
    work[PREVIOUS, place] = before
    work[CODE, place] = code
    work[REFERENCE, place] = code


@compiled
def difference(before: int, code: int, floor: int, kind: int) -> int:
    """Delta between two codes, saturated; 0 where there is no reference or yaw has wrapped."""
    if before == UNKNOWN:
        return 0
    if kind == _ANGLE:
        top = 1 - floor  # code of angles from 2 to 4 rad
        if top > 0 and abs(code) == top and before == -code:
            return 0
    return min(max(code - before, -LIMIT), LIMIT)


@compiled
def take_report(time_to_collision_s: float, future_collision_seq: float, work: Codes) -> None:
    """Deltas of a collision report; those of the other stages become 0."""
    take(work, 0, time_to_collision_s)
    take(work, 1, future_collision_seq)
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
    """Deltas of a control tick: waypoint `index` of (n, 10), none where negative, and a command.

    Those of the last report stay where `keep_report`, else they become 0.
    """
    if not keep_report:
        work[DELTA, :_PLANNING] = 0
    if index >= 0:
        for column in range(_CONTROL - _PLANNING):
            take(work, _PLANNING + column, waypoints[index, column])
    else:
        work[DELTA, _PLANNING:_CONTROL] = 0
    for axis in range(3):
        take(work, _CONTROL + axis, velocity_enu_mps[axis])
    take(work, _CONTROL + 3, yaw_rad)


@compiled
def plan_deltas(waypoints: FloatArray, first: int, work: Codes, steps: IntArray, out: Codes) -> int:
    """Deltas between consecutive waypoints (n, 10) from `first` on, where there are any.

    Writes the steps k, from waypoint k to k + 1, in which a code changes to `steps` (n,), and
    their deltas to `out` (n, COUNT). `work` stays as it is.

    Returns:
        How many there are.
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
            code = encode(waypoints[row, column], floor, work[CEILING, place], kind)
            if not begins:
                delta = difference(codes[column], code, floor, kind)
                out[count, place] = delta
                changed = changed or delta != 0
            codes[column] = code
        if changed:
            out[count, :_PLANNING] = 0
            out[count, _CONTROL:] = 0
            steps[count] = row - 1
            count += 1
    return count
