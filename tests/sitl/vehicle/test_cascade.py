"""The whole step is pure, bounded and forgetful of nonsense."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.core.frames import quaternion_from_euler
from sitl.vehicle import cascade
from sitl.vehicle.cascade import control_step
from sitl.vehicle.gains import gains_for
from sitl.vehicle.profile import PROFILES, load_profile
from sitl.vehicle.truth import T_ON_GROUND, T_QUATERNION, T_RATES, TRUTH_SIZE

GAINS = {name: gains_for(load_profile(name), 0.004) for name in PROFILES.names}
names = st.sampled_from(PROFILES.names)
anything = st.lists(st.floats(), min_size=19, max_size=19).map(np.array)
small = st.floats(-1.0, 1.0)


@st.composite
def measurements(draw, on_ground=0.0):
    measurement = np.zeros(TRUTH_SIZE)
    measurement[:6] = [100.0 * draw(small) for _ in range(3)] + [5.0 * draw(small)] * 3
    quaternion = quaternion_from_euler(*(3.0 * draw(small) for _ in range(3)))
    measurement[T_QUATERNION : T_QUATERNION + 4] = quaternion
    measurement[T_RATES : T_RATES + 3] = [10.0 * draw(small) for _ in range(3)]
    measurement[T_ON_GROUND] = on_ground
    return measurement


@settings(deadline=None)  # the first call may compile
@given(names, measurements(), st.lists(anything, min_size=1, max_size=5))
def test_any_setpoint_leaves_state_finite_and_commands_in_range(name, measurement, setpoints):
    state = np.zeros(cascade.STATE_SIZE)
    for setpoint in setpoints:
        state, commands = control_step(state, measurement, setpoint, GAINS[name], True)  # noqa: FBT003
        assert np.isfinite(state).all()
        assert (commands >= 0.0).all()
        assert (commands <= 1.0).all()


@settings(deadline=None)  # the first call may compile
@given(names, measurements(), anything)
def test_step_is_pure(name, measurement, setpoint):
    state = np.zeros(cascade.STATE_SIZE)
    state[cascade.S_FLYING] = 1.0
    copies = [array.copy() for array in (state, measurement, setpoint)]
    first = control_step(state, measurement, setpoint, GAINS[name], True)  # noqa: FBT003
    second = control_step(state, measurement, setpoint, GAINS[name], True)  # noqa: FBT003
    for array, copy in zip((state, measurement, setpoint), copies, strict=True):
        assert array.tobytes() == copy.tobytes()
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1].tobytes() == second[1].tobytes()


@settings(deadline=None)  # the first call may compile
@given(names, measurements(), anything)
def test_disarmed_motors_stand_still(name, measurement, setpoint):
    state, commands = control_step(
        np.ones(cascade.STATE_SIZE),
        measurement,
        setpoint,
        GAINS[name],
        False,  # noqa: FBT003
    )
    assert not commands.any()
    assert state[cascade.S_FLYING] == 0.0


@settings(deadline=None)  # the first call may compile
@given(names, measurements(on_ground=1.0), st.floats(-0.09, 1e9))
def test_on_the_ground_only_a_climb_lifts_off(name, measurement, down):
    setpoint = np.full(cascade.SETPOINT_SIZE, math.nan)
    setpoint[cascade.SP_VELOCITY + 2] = down
    state = np.zeros(cascade.STATE_SIZE)
    _, commands = control_step(state, measurement, setpoint, GAINS[name], True)  # noqa: FBT003
    assert 0.0 < commands.max() < 0.15
    setpoint[cascade.SP_VELOCITY + 2] = -1.0
    flying, _ = control_step(state, measurement, setpoint, GAINS[name], True)  # noqa: FBT003
    assert flying[cascade.S_FLYING] == 1.0
