from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mavfi_cli.core.frames import yaw_from_quaternion
from mavfi_cli.link.codec import dialect
from sitl.camera.station import PoseTracker


def position(ms: int, *, north: float = 0.0, east: float = 0.0, vn: float = 0.0) -> Any:
    return dialect.MAVLink_local_position_ned_message(ms, north, east, -5.0, vn, 0.0, 0.0)


def attitude(ms: int, heading: float) -> Any:
    w, z = math.cos(heading / 2.0), math.sin(heading / 2.0)
    return dialect.MAVLink_attitude_quaternion_message(ms, w, 0.0, 0.0, z, 0.0, 0.0, 0.0)


def test_a_pose_is_a_position_and_an_attitude_in_the_world() -> None:
    tracker = PoseTracker(np.array([100.0, 200.0, 0.0]))
    assert not tracker.take(attitude(1000, 0.0))
    with pytest.raises(LookupError):
        PoseTracker(np.zeros(3)).pose()
    assert not tracker.take(position(1000, north=3.0, east=4.0))
    assert tracker.take(attitude(1020, math.radians(90.0)))  # nose to the east
    stamp_s, place, quaternion, _ = tracker.pose()
    assert stamp_s == 1.02
    assert place == pytest.approx([104.0, 203.0, 5.0])
    assert yaw_from_quaternion(quaternion) == pytest.approx(0.0, abs=1e-12)


def test_the_position_is_carried_on_with_its_velocity_for_a_while() -> None:
    tracker = PoseTracker(np.zeros(3))
    tracker.take(position(1000, vn=2.0))
    tracker.take(attitude(1100, 0.0))
    assert tracker.pose()[1] == pytest.approx([0.0, 0.2, 5.0])
    tracker.take(attitude(9000, 0.0))
    assert tracker.pose()[1] == pytest.approx([0.0, 1.0, 5.0])


def test_euler_angles_serve_until_quaternions_come() -> None:
    tracker = PoseTracker(np.zeros(3))
    tracker.take(position(0))
    euler = dialect.MAVLink_attitude_message(10, 0.0, 0.0, math.pi / 2.0, 0.0, 0.0, 0.0)
    assert tracker.take(euler)
    assert not tracker.has_quaternion
    assert yaw_from_quaternion(tracker.pose()[2]) == pytest.approx(0.0, abs=1e-12)
    assert tracker.take(attitude(20, 0.0))
    assert not tracker.take(euler)


def test_values_that_are_none_are_skipped() -> None:
    tracker = PoseTracker(np.zeros(3))
    tracker.take(position(0, north=math.nan))
    assert not tracker.has_position
    tracker.take(position(0, vn=math.inf))
    assert not tracker.take(attitude(10, math.nan))
    zero = dialect.MAVLink_attitude_quaternion_message(10, 0, 0, 0, 0, 0, 0, 0)
    assert not tracker.take(zero)
    fresh = PoseTracker(np.zeros(3))
    assert not fresh.take(dialect.MAVLink_attitude_message(10, math.inf, 0, math.nan, 0, 0, 0))
    fresh.take(position(0, north=3e38))
    assert not fresh.has_position


def test_after_a_reboot_the_old_position_is_forgotten() -> None:
    tracker = PoseTracker(np.zeros(3))
    tracker.take(position(500_000))
    assert not tracker.take(attitude(10, 0.0))
    tracker.take(position(20))
    assert tracker.take(attitude(30, 0.0))
