"""Outer loops: what is controlled by what, and the integral that does not wind up."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.vehicle import cascade
from sitl.vehicle.cascade import acceleration_target, velocity_target
from sitl.vehicle.gains import gains_for
from sitl.vehicle.profile import load_profile
from sitl.vehicle.truth import T_QUATERNION, TRUTH_SIZE

GAINS = gains_for(load_profile("solo"), 0.004)
FREE = math.nan


def setpoint(**fields):
    clean = np.full(cascade.SETPOINT_SIZE, FREE)
    for name, values in fields.items():
        start = {"position": 0, "velocity": 3, "acceleration": 6}[name]
        clean[start : start + 3] = values
    return clean


def at_rest():
    measurement = np.zeros(TRUTH_SIZE)
    measurement[T_QUATERNION] = 1.0
    return measurement


def test_position_adds_to_velocity():
    clean = setpoint(position=(1.0, 0.0, 0.5), velocity=(0.5, FREE, 0.2))
    target = velocity_target(clean, at_rest(), GAINS)
    p = GAINS[cascade.G_POSITION_P : cascade.G_POSITION_P + 3]
    np.testing.assert_allclose(target, (p[0] + 0.5, 0.0, 0.5 * p[2] + 0.2))


def test_nothing_controlled_is_stand_still_and_acceleration_alone_is_free():
    np.testing.assert_array_equal(velocity_target(setpoint(), at_rest(), GAINS), np.zeros(3))
    target = velocity_target(setpoint(acceleration=(1.0, FREE, FREE)), at_rest(), GAINS)
    assert math.isnan(target[0])
    np.testing.assert_array_equal(target[1:], (0.0, 0.0))


@settings(deadline=None)  # the first call may compile
@given(st.lists(st.floats(-1e5, 1e5), min_size=3, max_size=3))
def test_far_positions_are_flown_to_within_the_speed_limits(position):
    target = velocity_target(setpoint(position=position), at_rest(), GAINS)
    assert math.hypot(target[0], target[1]) <= GAINS[cascade.G_SPEED_LIMIT] * (1 + 1e-12)
    assert -GAINS[cascade.G_CLIMB_LIMIT] <= target[2] <= GAINS[cascade.G_DESCENT_LIMIT]


def test_integral_is_limited_when_the_vehicle_is_stuck():
    state = np.zeros(cascade.STATE_SIZE)
    clean = setpoint(velocity=(5.0, -5.0, -3.0))
    for _ in range(20000):
        total = acceleration_target(clean[3:6].copy(), clean, at_rest(), state, GAINS)
    limits = GAINS[cascade.G_INTEGRAL_LIMIT : cascade.G_INTEGRAL_LIMIT + 3]
    integral = state[cascade.S_VELOCITY_INTEGRAL : cascade.S_VELOCITY_INTEGRAL + 3]
    np.testing.assert_allclose(np.abs(integral), limits)
    assert np.isfinite(total).all()


def test_model_is_the_closed_form_second_order_step():
    # tau v'' + v' + k v = k u: the reference model, small enough to meet no limit
    state = np.zeros(cascade.STATE_SIZE)
    clean = setpoint(velocity=(0.5, 0.0, 0.0))
    k, tau = GAINS[cascade.G_MODEL_P], GAINS[cascade.G_MODEL_LAG]
    measurement = at_rest()
    natural, damping = math.sqrt(k / tau), 0.5 / math.sqrt(k * tau)
    damped = natural * math.sqrt(1.0 - damping**2)
    for step in range(1, 500):
        acceleration_target(clean[3:6].copy(), clean, measurement, state, GAINS)
        t = step * 0.004
        decay = math.exp(-damping * natural * t)
        swing = math.cos(damped * t) + damping * natural / damped * math.sin(damped * t)
        expected = 0.5 * (1.0 - decay * swing)
        assert state[cascade.S_MODEL_VELOCITY] == pytest.approx(expected, abs=0.012)
