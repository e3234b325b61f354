import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.link.codec import dialect
from sitl.autopilot.services import setpoint_of
from sitl.geodesy import Origin

NAN = math.nan
ORIGIN = Origin()


def local_setpoint(message, heading_rad):
    return setpoint_of(message, heading_rad=heading_rad, origin=ORIGIN, home_down_m=0.0)


def global_setpoint(message, home_down_m):
    return setpoint_of(message, heading_rad=0.0, origin=ORIGIN, home_down_m=home_down_m)


def local(mask=2503, frame=1, **fields):
    values = {
        "time_boot_ms": 0, "target_system": 1, "target_component": 1, "coordinate_frame": frame,
        "type_mask": mask, "x": 1.0, "y": 2.0, "z": 3.0, "vx": 4.0, "vy": 5.0, "vz": 6.0,
        "afx": 0.1, "afy": 0.2, "afz": 0.3, "yaw": 0.5, "yaw_rate": 0.25, **fields,
    }  # fmt: skip
    return dialect.MAVLink_set_position_target_local_ned_message(**values)


@pytest.mark.parametrize(
    ("mask", "expected"),
    [
        (2503, [NAN, NAN, NAN, 4, 5, 6, NAN, NAN, NAN, 0.5, NAN]),  # MAVSDK velocity + yaw
        (1479, [NAN, NAN, NAN, 4, 5, 6, NAN, NAN, NAN, NAN, 0.25]),  # velocity + yaw rate
        (3527, [NAN, NAN, NAN, 4, 5, 6, NAN, NAN, NAN, NAN, NAN]),  # velocity only
        (4039, [NAN, NAN, NAN, 4, 5, 6, NAN, NAN, NAN, NAN, NAN]),  # MAVProxy's velocity
        (2552, [1, 2, 3, NAN, NAN, NAN, NAN, NAN, NAN, 0.5, NAN]),  # position + yaw
        (2496, [1, 2, 3, 4, 5, 6, NAN, NAN, NAN, 0.5, NAN]),
        (2048, [1, 2, 3, 4, 5, 6, 0.1, 0.2, 0.3, 0.5, NAN]),
        (2055, [NAN, NAN, NAN, 4, 5, 6, 0.1, 0.2, 0.3, 0.5, NAN]),  # with feed-forward
        (0, [1, 2, 3, 4, 5, 6, 0.1, 0.2, 0.3, 0.5, 0.25]),
        (2503 & ~0x4, [NAN, NAN, 3, 4, 5, 6, NAN, NAN, NAN, 0.5, NAN]),  # height held, v free
    ],
)
def test_mask_says_what_is_controlled(mask, expected):
    np.testing.assert_allclose(local_setpoint(local(mask), 0.0), [*expected, *[NAN] * 8])


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (4095, "invalid"),
        (2559, "invalid"),  # yaw alone
        (2111, "acceleration without velocity not supported"),
        (2055 | 0x200, "force not supported"),
    ],
)
def test_mask_that_is_not_supported_is_refused_in_words(mask, words):
    with pytest.raises(ValueError, match=f"^{words}$"):
        local_setpoint(local(mask), 0.0)


@pytest.mark.parametrize("frame", [0, 7, 9, 12, 255])
def test_frame_that_is_not_supported_is_refused_by_number(frame):
    with pytest.raises(ValueError, match=f"^coordinate frame {frame} unsupported$"):
        local_setpoint(local(frame=frame), 0.0)


@given(st.floats(-math.pi, math.pi))
def test_body_frame_turns_with_the_heading(heading):
    setpoint = local_setpoint(local(2055, frame=8), heading)
    turn = complex(math.cos(heading), math.sin(heading))
    velocity = complex(4.0, 5.0) * turn
    acceleration = complex(0.1, 0.2) * turn
    assert setpoint[3:6] == pytest.approx([velocity.real, velocity.imag, 6.0])
    assert setpoint[6:9] == pytest.approx([acceleration.real, acceleration.imag, 0.3])
    assert setpoint[9] == pytest.approx(0.5)


def test_position_in_the_body_frame_is_no_setpoint():
    with pytest.raises(ValueError, match="invalid"):
        local_setpoint(local(2552, frame=8), 0.0)


@pytest.mark.parametrize("value", [NAN, math.inf, -math.inf, 1e30])
def test_what_is_no_number_is_not_controlled(value):
    setpoint = local_setpoint(local(2503, vx=value, yaw=value), 0.0)
    assert math.isnan(setpoint[3])
    assert setpoint[4] == 5.0
    assert math.isnan(setpoint[9]) or math.isfinite(value)


def test_global_target_is_the_same_place():
    latitude, longitude = ORIGIN.geodetic(20.0, -30.0)

    def message(frame, alt):
        return dialect.MAVLink_set_position_target_global_int_message(
            0, 1, 1, frame, 2552, round(latitude * 1e7), round(longitude * 1e7), alt,
            0, 0, 0, 0, 0, 0, 0.5, 0,
        )  # fmt: skip

    for frame, alt in ((5, ORIGIN.altitude_amsl_m + 8.0), (6, 7.9), (11, 7.9)):
        setpoint = global_setpoint(message(frame, alt), home_down_m=-0.1)
        assert setpoint[:3] == pytest.approx([20.0, -30.0, -8.0], abs=0.02)
    with pytest.raises(ValueError, match="coordinate frame 1 unsupported"):
        global_setpoint(message(1, 0.0), 0.0)
