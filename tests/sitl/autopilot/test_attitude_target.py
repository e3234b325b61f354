"""SET_ATTITUDE_TARGET: what is followed, and what is refused, by PX4's type mask."""

import math

import numpy as np
import pytest

from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import FlightMode

NAN = math.nan
MODE, ARM = dialect.MAV_CMD_DO_SET_MODE, dialect.MAV_CMD_COMPONENT_ARM_DISARM
OFFBOARD = (1, 6, 0)
MAVSDK = 0b111  # ignores the rates


def target(mask=MAVSDK, q=(1.5, 0.0, 0.0, 0.0), rates=(0.1, 0.2, 0.3), thrust=0.7):
    return dialect.MAVLink_set_attitude_target_message(0, 1, 1, mask, list(q), *rates, thrust)


def test_offboard_follows_an_attitude(bench):
    bench.run(4.5, target)
    bench.command(MODE, *OFFBOARD)
    bench.command(ARM, 1.0)
    bench.run(2.0, target)
    assert bench.mode is FlightMode.OFFBOARD
    now = bench.autopilot.snapshot
    assert now.motors_on
    expected = [*[NAN] * 11, 0.7, 1.5, 0.0, 0.0, 0.0, NAN, NAN, NAN]
    np.testing.assert_allclose(now.setpoint, expected, atol=1e-7)


@pytest.mark.parametrize(
    ("mask", "attitude", "rates"),
    [
        (MAVSDK, [1.5, 0, 0, 0], [NAN, NAN, NAN]),
        (0, [1.5, 0, 0, 0], [NAN, NAN, 0.3]),  # the yaw rate only
        (128, [NAN] * 4, [0.1, 0.2, 0.3]),
        (128 | 4, [NAN] * 4, [0.1, 0.2, NAN]),
    ],
)
def test_the_mask_says_what_is_controlled(bench, mask, attitude, rates):
    bench.send(target(mask))
    expected = [*[NAN] * 11, 0.7, *attitude, *rates]
    np.testing.assert_allclose(bench.autopilot.snapshot.offboard, expected, atol=1e-7)
    assert bench.texts() == []


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (target(MAVSDK | 64), "without a collective thrust not supported"),
        (target(MAVSDK | 32), "without a collective thrust not supported"),
        (target(thrust=1.5), "thrust invalid"),
        (target(thrust=NAN), "thrust invalid"),
        (target(q=(0.0, 0.0, 0.0, 0.0)), "quaternion invalid"),
        (target(q=(NAN, 0.0, 0.0, 0.0)), "quaternion invalid"),
        (target(q=(1e30, 0.0, 0.0, 0.0)), "quaternion invalid"),
        (target(128 | 3), "SET_ATTITUDE_TARGET invalid"),
    ],
)
def test_what_cannot_be_followed_is_refused(bench, message, words):
    bench.send(message)
    assert np.isnan(bench.autopilot.snapshot.offboard).all()
    bench.tick()
    assert any(words in text for _, text in bench.texts())
