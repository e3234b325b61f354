"""The mixer inverts the rotor geometry where it can, and always stays within its range."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.vehicle import cascade
from sitl.vehicle.cascade import LEAST_SHARE, mix, throttle, thrust_shares
from sitl.vehicle.gains import gains_for
from sitl.vehicle.profile import PROFILES, load_profile

VEHICLES = {name: load_profile(name) for name in PROFILES.names}
GAINS = {name: gains_for(profile, 0.004) for name, profile in VEHICLES.items()}
names = st.sampled_from(PROFILES.names)
# Signs (forward, right) and sense (+1: counter-clockwise from above) of the rotors in the model.
ROTOR_LAYOUT = ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0))
torques = st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3).map(np.array)


def wrench(shares, name):
    """Collective and torque that rotor thrusts make, by the cross product of arm and force."""
    rotor = VEHICLES[name].rotor
    offset = rotor.arm_m / math.sqrt(2.0)
    collective, torque = 0.0, np.zeros(3)
    for share, (forward, right, sense) in zip(shares, ROTOR_LAYOUT, strict=True):
        thrust_n = share * rotor.max_thrust_n
        force = np.array([0.0, 0.0, -thrust_n])
        torque += np.cross([forward * offset, right * offset, 0.0], force)
        torque[2] += sense * rotor.torque_per_thrust_m * thrust_n
        collective += thrust_n
    return collective, torque


@settings(deadline=None)  # the first call may compile
@given(
    names,
    st.floats(0.35, 0.65),
    *[st.floats(-0.08, 0.08) for _ in range(3)],
)
def test_inverts_the_geometry_when_nothing_saturates(name, level, roll, pitch, yaw):
    gains = GAINS[name]
    unit = 4.0 * gains[cascade.G_ROTOR_THRUST]
    arm = unit * gains[cascade.G_ROTOR_OFFSET]
    torque = np.array([roll * arm, pitch * arm, yaw * unit * gains[cascade.G_TORQUE_PER_THRUST]])
    collective, made = wrench(thrust_shares(level * unit, torque, gains), name)
    assert collective == pytest.approx(level * unit, rel=1e-9)
    np.testing.assert_allclose(made, torque, rtol=0, atol=1e-9 * unit)


@settings(deadline=None)  # the first call may compile
@given(names, st.floats(-1e6, 1e6), torques)
def test_commands_are_within_zero_and_one(name, collective_n, torque_nm):
    shares = thrust_shares(collective_n, torque_nm, GAINS[name])
    assert (shares >= LEAST_SHARE).all()
    assert (shares <= 1.0).all()
    commands = mix(collective_n, torque_nm, GAINS[name])
    assert (commands >= 0.0).all()
    assert (commands <= 1.0).all()


@settings(deadline=None)  # the first call may compile
@given(names, st.floats(-2.0, 3.0), torques)
def test_roll_and_pitch_keep_their_direction_and_come_before_the_rest(name, level, torque_nm):
    gains = GAINS[name]
    unit = 4.0 * gains[cascade.G_ROTOR_THRUST]
    arm = unit * gains[cascade.G_ROTOR_OFFSET]
    _, made = wrench(thrust_shares(level * unit, torque_nm, gains), name)
    spread = 2.0 * (abs(torque_nm[0]) + abs(torque_nm[1])) / arm
    expected = torque_nm[:2] * min(1.0, (1.0 - LEAST_SHARE) / max(spread, 1e-300))
    np.testing.assert_allclose(made[:2], expected, rtol=1e-6, atol=1e-9 * arm)
    assert made[2] * torque_nm[2] >= -1e-9 * unit * unit


@settings(deadline=None)  # the first call may compile
@given(names, st.floats(0.0, 1.0))
def test_throttle_is_the_motor_equation(name, share):
    # V = rpm / Kv + R (Q / Kt + I0), Drela's first-order motor
    rotor = VEHICLES[name].rotor
    current = share * rotor.max_thrust_n * rotor.torque_per_thrust_m / rotor.torque_constant_nmpa
    volts = math.sqrt(share) * rotor.max_rpm / rotor.motor_kv_rpmpv
    volts += rotor.motor_resistance_ohm * (current + rotor.motor_no_load_current_a)
    expected = volts / rotor.full_throttle_voltage_v
    assert throttle(share, GAINS[name]) == pytest.approx(expected, rel=1e-12)
