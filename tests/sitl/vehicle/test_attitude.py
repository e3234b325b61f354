"""Attitude laws: the force keeps its limits, and the rates turn the right way."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mavfi_cli.core.frames import quaternion_from_euler, rotation_matrix
from sitl.vehicle import cascade
from sitl.vehicle.cascade import rotation, specific_force, tilt_rates
from sitl.vehicle.gains import gains_for
from sitl.vehicle.profile import PROFILES, load_profile
from sitl.vehicle.truth import T_QUATERNION, TRUTH_SIZE

GAINS = {name: gains_for(load_profile(name), 0.004) for name in PROFILES.names}
angles = st.floats(-3.0, 3.0)
accelerations = st.lists(st.floats(-50.0, 50.0), min_size=3, max_size=3).map(np.array)


def measured(quaternion):
    measurement = np.zeros(TRUTH_SIZE)
    measurement[T_QUATERNION : T_QUATERNION + 4] = quaternion
    return measurement


@settings(deadline=None)  # the first call may compile
@given(angles, st.floats(-1.5, 1.5), angles)
def test_rotation_is_the_one_of_the_frames_module(roll, pitch, yaw):
    quaternion = quaternion_from_euler(roll, pitch, yaw)
    np.testing.assert_allclose(
        rotation(measured(quaternion)), rotation_matrix(quaternion), rtol=0, atol=1e-14
    )


@settings(deadline=None)  # the first call may compile
@given(st.sampled_from(PROFILES.names), accelerations)
def test_force_keeps_tilt_and_thrust_limits_and_the_height(name, acceleration):
    gains = GAINS[name]
    force = specific_force(acceleration, gains)
    horizontal = math.hypot(force[0], force[1])
    largest = 4.0 * gains[cascade.G_ROTOR_THRUST] / gains[cascade.G_MASS]
    assert force[2] < 0.0
    assert horizontal <= -force[2] * gains[cascade.G_TILT_TANGENT] * (1.0 + 1e-12)
    assert np.linalg.norm(force) <= 0.9 * largest * (1.0 + 1e-12)
    wanted = acceleration[2] - gains[cascade.G_GRAVITY]
    margin = min(math.hypot(acceleration[0], acceleration[1]), 0.2 * gains[cascade.G_GRAVITY])
    if -math.sqrt((0.9 * largest) ** 2 - margin**2) < wanted < -0.25 * gains[cascade.G_GRAVITY]:
        assert force[2] == wanted
    assert force[0] * acceleration[1] == pytest.approx(force[1] * acceleration[0], abs=1e-9)


@settings(deadline=None)  # the first call may compile
@given(angles, st.floats(-1.4, 1.4), angles, accelerations)
def test_rates_turn_the_thrust_towards_the_force(roll, pitch, yaw, acceleration):
    gains = GAINS["solo"]
    quaternion = quaternion_from_euler(roll, pitch, yaw)
    matrix = rotation(measured(quaternion))
    force = specific_force(acceleration, gains)
    wanted_down = -force / np.linalg.norm(force)
    angle = math.acos(min(max(float(matrix[:, 2] @ wanted_down), -1.0), 1.0))
    assume(1e-3 < angle < 3.1)
    rates = tilt_rates(force, matrix, gains)
    assert rates[2] == 0.0
    size = np.linalg.norm(rates)
    assert size == pytest.approx(
        min(gains[cascade.G_TILT_P] * angle, gains[cascade.G_TILT_RATE_LIMIT]), rel=1e-6
    )
    # turning by `angle` about that axis brings the body's down axis onto the wanted one
    axis = matrix @ (rates / size)
    down = matrix[:, 2]
    turned = down * math.cos(angle) + np.cross(axis, down) * math.sin(angle)
    np.testing.assert_allclose(turned, wanted_down, rtol=0, atol=1e-6)


def test_upside_down_still_turns():
    matrix = rotation(measured(quaternion_from_euler(math.pi, 0.0, 0.0)))
    assert np.linalg.norm(tilt_rates(np.array([0.0, 0.0, -9.8]), matrix, GAINS["solo"])) > 1.0
