import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import WAYPOINT_FIELDS, Stage
from mavfi_cli.detect import preprocess as pre
from mavfi_cli.detect.preprocess import NAMES, PreprocessParams

KEEPS_REPORT = False


def taken(*values, place="waypoint_x", **params):
    """The working array after some values of a state have arrived one after the other."""
    work = PreprocessParams(**params).working_array()
    for value in values:
        waypoint = np.zeros((1, 10))
        if place in NAMES[2:9]:
            waypoint[0, NAMES.index(place) - 2] = value
            pre.take_tick(waypoint, 0, np.zeros(3), 0.0, KEEPS_REPORT, work)
        else:
            both = {"time_to_collision": 1.0, "future_collision_seq": 0.0, place: value}
            pre.take_report(*both.values(), work)
    return work[:, NAMES.index(place)].tolist()


def code(value, floor=0, **others):
    floors = {} if "place" in others else {"position_floor": floor}
    return taken(value, **floors, **others)[pre.CODE]


def delta(*values, **others):
    return taken(*values, **others)[pre.DELTA]


def exponent_bits(value):
    return struct.unpack("<Q", struct.pack("<d", value))[0] >> 52 & 0x7FF


def test_the_thirteen_inputs_are_those_of_the_paper_in_table_order():
    assert NAMES == (
        "time_to_collision", "future_collision_seq",
        "waypoint_x", "waypoint_y", "waypoint_z", "waypoint_yaw",
        "waypoint_vx", "waypoint_vy", "waypoint_vz",
        "command_vx", "command_vy", "command_vz", "command_yaw",
    )  # fmt: skip
    assert pre.SPANS == {Stage.PERCEPTION: (0, 2), Stage.PLANNING: (2, 9), Stage.CONTROL: (9, 13)}
    assert {stage: pre.span(stage) for stage in Stage} == pre.SPANS
    # Columns of a waypoint are taken as they come.
    assert [f"waypoint_{field}" for field in WAYPOINT_FIELDS[:7]] == list(NAMES[2:9])


@settings(deadline=None)  # the first call may compile
@given(st.floats(min_value=1e-300, max_value=1e300), st.integers(-20, 20))
def test_a_code_is_sign_and_exponent_above_the_floor(value, floor):
    expected = max(0, exponent_bits(value) - 1023 - floor)
    assert code(value, floor) == expected
    assert code(-value, floor) == -expected


@settings(deadline=None)
@given(st.floats(allow_nan=False), st.integers(0, 51))
def test_the_mantissa_is_not_read(value, bit):
    pattern = struct.unpack("<Q", struct.pack("<d", value))[0] ^ 1 << bit
    other = struct.unpack("<d", struct.pack("<Q", pattern))[0]
    if math.isfinite(value) and min(abs(value), abs(other)) > 1e-300:
        assert code(value, -5) == code(other, -5)


def test_values_through_zero_and_special_ones():
    assert [code(v) for v in (-1.9, -0.1, -0.0, 0.0, 5e-324, 0.7, 1.9)] == [0] * 7
    assert [code(v) for v in (2.0, -2.0, 3.9, 4.0)] == [1, -1, 1, 2]
    assert code(math.inf) == 1024
    assert code(-math.inf) == -1024
    assert code(math.nan) == code(-math.nan) == pre.NAN_CODE
    endless = {"place": "time_to_collision", "time_to_collision_ceiling": 4}
    assert code(math.inf, **endless) == code(17.0, **endless) == 4
    assert code(7, place="future_collision_seq") == 7
    assert code(-(2.0**31), place="future_collision_seq") == -pre.LIMIT


def test_differences():
    assert delta(500.0) == 0  # nothing was known before
    assert delta(2.0, -2.0) == -2
    assert delta(8.0, 32.0) == 2
    assert delta(2.0**31, -(2.0**31), place="future_collision_seq") == -pre.LIMIT


def test_yaw_wraps_and_its_sign_flip_elsewhere_does_not():
    yaw = {"place": "waypoint_yaw"}
    assert delta(3.1, -3.1, **yaw) == delta(-3.1, 3.1, **yaw) == 0
    assert abs(delta(1.2, -1.2, **yaw)) == 2 * abs(code(1.2, **yaw)) > 0


def test_reports_and_ticks_write_only_what_is_theirs():
    keep = True
    work = PreprocessParams().working_array()
    waypoints = np.zeros((2, 10))
    waypoints[1, 0] = 9.0
    pre.take_report(math.inf, 1, work)
    pre.take_tick(waypoints, 0, np.zeros(3), 0.0, keep, work)
    assert not work[pre.DELTA].any()  # nothing was known before
    pre.take_report(3.0, 2, work)
    pre.take_tick(waypoints, 1, np.array([0.0, 0.0, 2.5]), 0.0, keep, work)
    expected = dict.fromkeys(NAMES, 0) | {
        "time_to_collision": -3, "future_collision_seq": 1, "waypoint_x": 3, "command_vz": 4,
    }  # fmt: skip
    assert dict(zip(NAMES, work[pre.DELTA].tolist(), strict=True)) == expected
    pre.take_tick(waypoints, -1, np.array([0.0, 0.0, 2.5]), 0.0, not keep, work)
    assert not work[pre.DELTA].any()


def test_parameters_have_a_digest_and_bounds():
    assert PreprocessParams().digest() == PreprocessParams().digest()
    assert PreprocessParams(yaw_floor=-3).digest() != PreprocessParams().digest()
    with pytest.raises(ConfigError, match=r"position_floor: .* got 2000"):
        PreprocessParams(position_floor=2000)
    with pytest.raises(ConfigError, match="must be above the floor"):
        PreprocessParams(time_to_collision_ceiling=0)
