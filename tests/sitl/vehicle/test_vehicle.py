"""What a vehicle does on the ground, between ground and air, and twice."""

import math
import os

import numpy as np
import pytest

from mavfi_cli.core.frames import enu_from_ned, flu_enu_from_frd_ned, yaw_from_quaternion
from sitl.vehicle.cascade import SETPOINT_SIZE
from sitl.vehicle.profile import load_profile
from sitl.vehicle.vehicle import PHYSICS_DT_S, T_ON_GROUND, Quadrotor

NAMES = ("solo", "spark", "solo+0.3")


@pytest.mark.parametrize("name", NAMES)
def test_disarmed_stays_put(grounded, setpoint, name):
    flight = grounded(name)
    start = flight.truth.position_ned_m.copy()
    record = flight.fly(setpoint(velocity=(3.0, 0.0, -3.0)), 5.0, armed=False)
    assert np.abs(record.position - start).max() < 1e-5
    assert record.rows[:, T_ON_GROUND].all()
    assert not flight.truth.motor_commands.any()
    assert not flight.truth.motor_rpm.any()
    assert flight.truth.power_regression_w == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_armed_idle_does_not_take_off(grounded, setpoint, name):
    flight = grounded(name)
    start = flight.truth.position_ned_m.copy()
    for idle in (setpoint(), setpoint(velocity=(1.0, 1.0, 0.0)), setpoint(velocity=(0, 0, 1.0))):
        record = flight.fly(idle, 3.0)
        assert np.abs(record.position - start).max() < 1e-3
        assert record.rows[:, T_ON_GROUND].all()
    assert (flight.truth.motor_rpm > 100.0).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.7), (0.0, 0.0, 1.5), (0.5, 0.0, 0.7)])
def test_takes_off_and_lands_without_bouncing(grounded, setpoint, name, velocity):
    flight = grounded(name)
    rest_height_m = flight.vehicle.profile.rest_height_m
    flight.fly(setpoint(velocity=(0.0, 0.0, -1.0)), 3.0)
    assert not flight.truth.on_ground
    record = flight.fly(setpoint(velocity=velocity), 8.0)
    touched = int(np.argmax(record.rows[:, T_ON_GROUND]))
    assert touched > 0
    assert record.rows[touched:, T_ON_GROUND].all()
    height = -record.position[touched:, 2]
    assert height.min() > rest_height_m / 2.0
    assert height.max() < rest_height_m + 0.02
    assert record.tilt_deg[touched:].max() < 20.0
    assert np.linalg.norm(record.velocity[-1]) < 1e-3
    assert height[-1] == pytest.approx(rest_height_m, abs=1e-3)
    flight.fly(setpoint(velocity=(0.0, 0.0, -1.0)), 2.0)
    assert not flight.truth.on_ground


def test_start_pose(grounded):
    flight = grounded("solo", position_enu_m=(30.0, -20.0, 7.0), yaw_enu_rad=2.0)
    np.testing.assert_allclose(
        enu_from_ned(flight.truth.position_ned_m), (30.0, -20.0, 7.0), rtol=0, atol=1e-6
    )
    quaternion = flu_enu_from_frd_ned(flight.truth.quaternion_frd_ned)
    assert yaw_from_quaternion(quaternion) == pytest.approx(2.0, abs=1e-9)
    assert not flight.truth.on_ground
    standing = grounded("solo", position_enu_m=(3.0, 4.0, 0.0))
    assert -standing.truth.position_ned_m[2] == pytest.approx(0.10387, abs=1e-4)
    assert standing.truth.on_ground


def test_falls_and_stays_down_when_disarmed_in_the_air(airborne, setpoint):
    flight = airborne("spark")
    flight.fly(setpoint(), 4.0, armed=False)
    assert flight.truth.on_ground
    assert np.linalg.norm(flight.truth.velocity_ned_mps) < 0.01


def test_stamp_is_the_step_count(grounded, setpoint):
    flight = grounded("solo")
    for step in range(1, 2001):
        flight.vehicle.step(setpoint(), False)  # noqa: FBT003
        assert flight.truth.stamp_s == step * PHYSICS_DT_S


def wandering(seconds):
    return np.array(
        [
            *(math.nan,) * 3,
            2.0 * math.sin(seconds),
            3.0 * math.cos(0.7 * seconds),
            -0.3 + math.sin(0.3 * seconds),
            *(math.nan,) * 3,
            0.5 * seconds,
            *(math.nan,) * 9,
        ]
    )


@pytest.mark.parametrize("name", ["solo", "spark"])
def test_two_vehicles_are_bit_equal(airborne, name):
    first = airborne(name).fly(wandering, 8.0).rows
    second = airborne(name).fly(wandering, 8.0).rows
    assert first.tobytes() == second.tobytes()


def test_two_vehicles_at_once_do_not_disturb_each_other(airborne):
    alone = airborne("solo").fly(wandering, 2.0).rows
    one, other = airborne("solo"), airborne("spark")
    rows = []
    for step in range(500):
        one.vehicle.step(wandering(step * PHYSICS_DT_S), True)  # noqa: FBT003
        other.vehicle.step(wandering(1.0 - step * PHYSICS_DT_S), True)  # noqa: FBT003
        rows.append(one.truth.flat.copy())
    assert np.array(rows).tobytes() == alone.tobytes()


def test_position_is_the_integral_of_velocity(airborne, setpoint):
    flight = airborne("solo")
    start = flight.truth.position_ned_m.copy()
    legs = [(3.0, 4.0, 0.0), (-5.0, 2.0, -0.5), (8.0, -6.0, 0.3), (0.0, 0.0, 0.0)]
    travelled = np.zeros(3)
    length = 0.0
    last = flight.truth.velocity_ned_mps.copy()
    for leg in legs:
        record = flight.fly(setpoint(velocity=leg), 9.0)
        velocity = np.vstack([last, record.velocity])
        travelled += ((velocity[1:] + velocity[:-1]) / 2.0 * PHYSICS_DT_S).sum(axis=0)
        length += np.linalg.norm(record.position[-1] - record.position[0])
        last = record.velocity[-1]
    assert length > 150.0
    np.testing.assert_allclose(flight.truth.position_ned_m - start, travelled, rtol=0, atol=2e-3)


def test_far_corner_flies_like_the_origin(grounded):
    # The plane must stay a plane: 140 m away the same flight has the same shape.
    corner = np.array([100.0, 100.0, 5.0])
    home = grounded("solo", position_enu_m=(0.0, 0.0, 5.0)).fly(wandering, 20.0)
    away = grounded("solo", position_enu_m=corner).fly(wandering, 20.0)
    offset = away.position - home.position
    np.testing.assert_allclose(offset - (100.0, 100.0, 0.0), 0.0, rtol=0, atol=1e-3)


def test_truth_cannot_be_written(grounded):
    with pytest.raises(ValueError, match="read-only"):
        grounded("solo").truth.position_ned_m[0] = 1.0


def test_prints_and_writes_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    vehicle = Quadrotor(load_profile("solo"), position_enu_m=(0, 0, 1.0), yaw_enu_rad=0.0)
    for _ in range(300):
        vehicle.step(np.full(SETPOINT_SIZE, math.nan), True)  # noqa: FBT003
    del vehicle
    assert os.listdir(tmp_path) == []
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err == ""
