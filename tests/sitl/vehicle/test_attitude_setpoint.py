"""Attitude and body-rate setpoints, with a thrust."""

import math

import numpy as np
import pytest

from sitl.vehicle.cascade import G_GRAVITY, G_MASS, G_ROTOR_THRUST, mix
from sitl.vehicle.gains import gains_for
from sitl.vehicle.profile import PROFILES, load_profile
from sitl.vehicle.truth import T_RATES
from sitl.vehicle.vehicle import PHYSICS_DT_S

LEVEL = (1.0, 0.0, 0.0, 0.0)


def hovering(name):
    """The motor command that carries the vehicle at rest."""
    gains = gains_for(load_profile(name), PHYSICS_DT_S)
    assert gains[G_MASS] * gains[G_GRAVITY] < 4.0 * gains[G_ROTOR_THRUST]
    return mix(gains[G_MASS] * gains[G_GRAVITY], np.zeros(3), gains)[0]


@pytest.mark.parametrize("name", PROFILES.names)
def test_the_thrust_is_the_motors_command(airborne, setpoint, name):
    flight = airborne(name)
    for thrust in (0.3, 0.6, 0.9):
        given = setpoint(thrust=thrust, body_rates=(0.0, 0.0, 0.0))
        flight.fly(given, PHYSICS_DT_S)
        assert flight.truth.motor_commands.mean() == pytest.approx(thrust, abs=0.02)


@pytest.mark.parametrize("name", PROFILES.names)
def test_it_lifts_off_only_if_the_thrust_carries_it(grounded, setpoint, name):
    flight = grounded(name)
    heights = []
    for share in (0.9, 1.1):
        given = setpoint(thrust=share * hovering(name), attitude=LEVEL)
        flight.fly(given, 1.0)
        heights.append(-flight.truth.position_ned_m[2] - flight.vehicle.profile.rest_height_m)
    assert heights[0] < 0.01 < 0.05 < heights[1]


@pytest.mark.parametrize("name", PROFILES.names)
@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "yaw_deg"), [(20, 0, 40), (0, -15, 40), (-30, 10, 60)]
)
def test_it_takes_the_attitude_and_keeps_it(airborne, setpoint, name, roll_deg, pitch_deg, yaw_deg):
    flight = airborne(name)
    roll, pitch, yaw = (math.radians(angle) / 2.0 for angle in (roll_deg, pitch_deg, yaw_deg))
    q_roll = np.array([math.cos(roll), math.sin(roll), 0.0, 0.0])
    q_pitch = np.array([math.cos(pitch), 0.0, math.sin(pitch), 0.0])
    q_yaw = np.array([math.cos(yaw), 0.0, 0.0, math.sin(yaw)])
    attitude = product(product(q_yaw, q_pitch), q_roll)
    flight.fly(setpoint(thrust=hovering(name), attitude=attitude), 3.0)
    found = np.degrees(flight.truth.euler_rad)
    np.testing.assert_allclose(found, (roll_deg, pitch_deg, yaw_deg), atol=2.0)


@pytest.mark.parametrize("name", PROFILES.names)
def test_it_turns_at_the_body_rates(airborne, setpoint, name):
    flight = airborne(name)
    record = flight.fly(setpoint(thrust=hovering(name), body_rates=(0.2, -0.1, 0.3)), 0.6)
    rates = record.rows[-1, T_RATES : T_RATES + 3]
    np.testing.assert_allclose(rates, (0.2, -0.1, 0.3), atol=0.08)


@pytest.mark.parametrize("name", PROFILES.names)
def test_a_velocity_takes_over_without_a_jump(airborne, setpoint, name):
    flight = airborne(name)
    pitched = (math.cos(-0.1), 0.0, math.sin(-0.1), 0.0)
    flight.fly(setpoint(thrust=hovering(name), attitude=pitched), 1.5)
    record = flight.fly(setpoint(velocity=(0.0, 0.0, 0.0)), 5.0)
    assert np.linalg.norm(record.velocity[-1]) < 0.1
    assert record.tilt_deg.max() < 45.0


def product(p, q):
    """The Hamilton product of two quaternions (4,) w x y z."""
    w, v = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([w, *v])
