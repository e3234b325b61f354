"""The figures that the vehicle must reach, flown on the real physics."""

import math

import numpy as np
import pytest

VEHICLES = ("solo", "spark", "solo+0.3")
STILL = (0.0, 0.0, 0.0)
STEP = 2.0
DIRECTIONS = {
    "north": (1.0, 0.0, 0.0),
    "west": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, -1.0),
    "diagonal": (math.sqrt(0.5), math.sqrt(0.5), 0.0),
    "diagonal-up": (math.sqrt(1 / 3), -math.sqrt(1 / 3), -math.sqrt(1 / 3)),
}


def check_step(record, start, end):
    size = np.linalg.norm(end - start)
    along = (record.velocity - start) @ (end - start) / size
    error = np.linalg.norm(record.velocity - end, axis=1)
    assert along.max() < 1.10 * size
    assert record.settling_s(error, 0.05 * size) < 2.0
    assert error[-1] < 0.05 * size


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_velocity_step_and_stop(airborne, setpoint, name, direction):
    flight = airborne(name)
    velocity = STEP * np.array(DIRECTIONS[direction])
    check_step(flight.fly(setpoint(velocity=velocity), 3.0), np.zeros(3), velocity)
    check_step(flight.fly(setpoint(velocity=STILL), 3.0), velocity, np.zeros(3))


def test_a_vehicle_short_of_thrust_still_flies_where_it_should(airborne, setpoint):
    # 2.7 kg on 38 N: climbing and turning together want more than there is.
    flight = airborne("solo+1.2")
    velocity = STEP * np.array(DIRECTIONS["diagonal-up"])
    check_step(flight.fly(setpoint(velocity=velocity), 3.0), np.zeros(3), velocity)
    check_step(flight.fly(setpoint(velocity=STILL), 3.0), velocity, np.zeros(3))
    record = flight.fly(setpoint(velocity=(12.0, 0.0, -3.0)), 8.0)
    np.testing.assert_allclose(record.velocity[-1], (12.0, 0.0, -3.0), atol=0.6)


@pytest.mark.parametrize("name", VEHICLES)
def test_hover_drift(airborne, setpoint, name):
    record = airborne(name).fly(setpoint(velocity=STILL), 60.0)
    drift = np.linalg.norm(record.position - record.position[0], axis=1)
    assert drift.max() < 0.1


@pytest.mark.parametrize("name", VEHICLES)
def test_yaw_steps_hold_position(airborne, setpoint, name):
    flight = airborne(name)
    start = flight.truth.position_ned_m.copy()
    heading = flight.fly(setpoint(velocity=STILL), 0.1).heading[-1]
    for turn in (1, 1, -1, 1, 1):
        heading += turn * math.pi / 2.0
        record = flight.fly(setpoint(velocity=STILL, yaw=heading), 3.0)
        error = (record.heading - heading + math.pi) % (2.0 * math.pi) - math.pi
        assert np.linalg.norm(record.position - start, axis=1).max() < 0.2
        assert record.settling_s(np.abs(error), math.radians(4.5)) < 2.0
        assert turn * error.max() < math.radians(9.0)
        assert abs(error[-1]) < math.radians(1.0)


def ramp(seconds):
    """Velocity and acceleration north: up to 3 m/s at 5 m/s^2, back to -3 m/s from t = 2 s."""
    if seconds < 2.0:
        return min(5.0 * seconds, 3.0), 5.0 if seconds < 0.6 else 0.0
    return max(3.0 - 5.0 * (seconds - 2.0), -3.0), -5.0 if seconds < 3.2 else 0.0


@pytest.mark.parametrize("name", VEHICLES)
def test_ramps_with_feed_forward(airborne, setpoint, name):
    flight = airborne(name)

    def target(seconds):
        velocity, acceleration = ramp(seconds)
        return setpoint(velocity=(velocity, 0.0, 0.0), acceleration=(acceleration, 0.0, 0.0))

    record = flight.fly(target, 5.0)
    # Followed no more than 0.15 s late, without overshoot, without losing height.
    late = np.array([ramp(max(t - 0.12, 0.0))[0] for t in record.time_s])
    assert np.abs(record.velocity[:, 0] - late).max() < 0.45
    assert np.abs(record.velocity[:, 0]).max() < 3.0 * 1.05
    assert np.ptp(record.position[:, 2]) < 0.15


@pytest.mark.parametrize("name", VEHICLES)
def test_feed_forward_follows_a_curve_closer(airborne, setpoint, name):
    def curve(seconds, *, forward):
        angle = 1.5 * seconds
        velocity = (3.0 * math.cos(angle), 3.0 * math.sin(angle), 0.0)
        acceleration = (-4.5 * math.sin(angle), 4.5 * math.cos(angle), 0.0)
        return setpoint(
            velocity=velocity, acceleration=acceleration if forward else (math.nan,) * 3
        )

    errors = []
    for forward in (True, False):
        flight = airborne(name)
        flight.fly(curve(0.0, forward=False), 2.0)
        record = flight.fly(lambda t, forward=forward: curve(t, forward=forward), 6.0)
        wanted = np.array([curve(t, forward=False)[3:6] for t in record.time_s])
        errors.append(np.linalg.norm(record.velocity - wanted, axis=1)[250:].max())
    assert errors[0] < 0.6
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize("name", VEHICLES)
def test_position_setpoint_is_reached_and_held(airborne, setpoint, name):
    flight = airborne(name)
    goal = flight.truth.position_ned_m + np.array([5.0, -3.0, -2.0])
    record = flight.fly(setpoint(position=goal), 9.0)
    assert np.linalg.norm(record.position[-1] - goal) < 0.02
    assert (record.position[:, 0] - goal[0]).max() < 0.2


@pytest.mark.parametrize("name", VEHICLES)
def test_limits_of_speed_and_tilt(airborne, setpoint, name):
    flight = airborne(name)
    limits = flight.vehicle.profile.limits
    record = flight.fly(setpoint(velocity=(50.0, 0.0, -50.0)), 6.0)
    assert record.velocity[-1, 0] == pytest.approx(limits.horizontal_speed_mps, rel=0.02)
    assert record.velocity[-1, 2] == pytest.approx(-limits.climb_mps, rel=0.02)
    assert record.tilt_deg.max() < limits.tilt_deg + 3.0
    record = flight.fly(setpoint(velocity=(0.0, 0.0, 50.0)), 6.0)
    assert record.velocity[-1, 2] == pytest.approx(limits.descent_mps, rel=0.02)
    assert record.tilt_deg.max() < limits.tilt_deg + 3.0


def test_yaw_rate_setpoint(airborne, setpoint):
    flight = airborne("solo")
    record = flight.fly(setpoint(velocity=(1.0, 0.0, 0.0), yaw_rate=0.7), 4.0)
    turned = np.unwrap(record.heading)
    assert (turned[-1] - turned[-251]) / 1.0 == pytest.approx(0.7, rel=0.01)
    np.testing.assert_allclose(record.velocity[-1], (1.0, 0.0, 0.0), atol=0.05)
    held = flight.fly(setpoint(velocity=STILL), 3.0).heading
    assert abs(held[-1] - held[-250]) < 0.01


def test_acceleration_alone_steers_an_axis(airborne, setpoint):
    flight = airborne("solo")
    record = flight.fly(
        setpoint(velocity=(math.nan, 0.0, 0.0), acceleration=(1.0, math.nan, math.nan)), 2.0
    )
    gained = record.velocity[-1, 0] - record.velocity[250, 0]
    assert gained == pytest.approx(1.0 * (record.time_s[-1] - record.time_s[250]), rel=0.1)


@pytest.mark.parametrize("name", ["solo", "spark"])
def test_hostile_setpoints_leave_nothing_behind(airborne, setpoint, name):
    flight = airborne(name)
    draw = np.random.default_rng(7)
    values = np.array([math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -1e30, 0.0, 2.0])
    for _ in range(40):
        record = flight.fly(np.append(draw.choice(values, size=11), [math.nan] * 8), 0.1)
        assert np.isfinite(record.rows).all()
        assert record.tilt_deg.max() < 45.0
        if flight.truth.position_ned_m[2] > -3.0:
            flight.fly(setpoint(velocity=(0.0, 0.0, -3.0)), 1.0)
    record = flight.fly(setpoint(velocity=STILL), 8.0)
    assert np.linalg.norm(record.velocity[-1]) < 0.05
