"""Cleaning keeps what is sane, and lets nothing else through."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.vehicle import cascade
from sitl.vehicle.cascade import FARTHEST_M, SETPOINT_SIZE, clean_setpoint, wrap
from sitl.vehicle.gains import gains_for
from sitl.vehicle.profile import load_profile

GAINS = gains_for(load_profile("solo"), 0.004)
anything = st.lists(st.floats(), min_size=11, max_size=11).map(np.array)
sane = st.lists(st.floats(-1.0, 1.0), min_size=11, max_size=11).map(np.array)


@settings(deadline=None)  # the first call may compile
@given(sane)
def test_sane_setpoints_pass_unchanged(setpoint):
    np.testing.assert_allclose(clean_setpoint(setpoint, GAINS), setpoint, rtol=0, atol=1e-15)


@settings(deadline=None)  # the first call may compile
@given(anything)
def test_everything_is_limited(setpoint):
    given_setpoint = setpoint.copy()
    clean = clean_setpoint(setpoint, GAINS)
    np.testing.assert_array_equal(setpoint, given_setpoint)
    np.testing.assert_array_equal(np.isnan(clean), ~np.isfinite(setpoint))
    finite = np.nan_to_num(clean)
    assert (np.abs(finite[:3]) <= FARTHEST_M).all()
    assert np.hypot(finite[3], finite[4]) <= GAINS[cascade.G_SPEED_LIMIT] * (1 + 1e-12)
    assert -GAINS[cascade.G_CLIMB_LIMIT] <= finite[5] <= GAINS[cascade.G_DESCENT_LIMIT]
    assert np.hypot(finite[6], finite[7]) <= GAINS[cascade.G_ACCELERATION_LIMIT] * (1 + 1e-12)
    assert abs(finite[8]) <= GAINS[cascade.G_ACCELERATION_LIMIT + 1]
    assert -math.pi <= finite[9] <= math.pi
    assert abs(finite[10]) <= GAINS[cascade.G_YAW_RATE_LIMIT]


@settings(deadline=None)  # the first call may compile
@given(st.floats(-12.0, 12.0), st.floats(-12.0, 12.0))
def test_speed_limit_keeps_the_direction(x, y):
    setpoint = np.full(SETPOINT_SIZE, math.nan)
    setpoint[3:5] = 10.0 * x, 10.0 * y
    clean = clean_setpoint(setpoint, GAINS)
    np.testing.assert_allclose(clean[3] * setpoint[4], clean[4] * setpoint[3], atol=1e-9)


@settings(deadline=None)  # the first call may compile
@given(st.floats(-1e4, 1e4))
def test_wrap_is_the_same_angle(angle):
    wrapped = wrap(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)
