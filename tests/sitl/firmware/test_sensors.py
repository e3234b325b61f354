"""Sensors of the vehicle for real firmware: truth plus noise from a seed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sitl.firmware.sensors import (
    BAROMETER_PA,
    FIELD_NED_GAUSS,
    FIX_HORIZONTAL_M,
    MAGNETOMETER_GAUSS,
    Sensors,
)
from sitl.geodesy import Origin
from sitl.vehicle.profile import GRAVITY_MPS2, load_profile
from sitl.vehicle.truth import T_QUATERNION, TRUTH_SIZE, Truth
from sitl.vehicle.vehicle import Quadrotor


def _at_rest(quaternion: list[float]) -> Truth:
    flat = np.zeros(TRUTH_SIZE)
    flat[T_QUATERNION : T_QUATERNION + 4] = quaternion
    return Truth(flat)


LEVEL = _at_rest([1.0, 0.0, 0.0, 0.0])
QUARTER = math.sqrt(0.5)


def _felt(truth: Truth) -> np.ndarray:
    """The mean of many measurements of the accelerometer."""
    sensors = Sensors(7)
    return np.mean([sensors.inertial(truth)[1] for _ in range(4000)], axis=0)


@pytest.mark.parametrize(
    ("quaternion", "force"),
    [
        ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0]),
        ([QUARTER, QUARTER, 0.0, 0.0], [0.0, -1.0, 0.0]),  # rolled right: the left side is up
        ([QUARTER, 0.0, QUARTER, 0.0], [1.0, 0.0, 0.0]),  # nose up
        ([QUARTER, 0.0, 0.0, QUARTER], [0.0, 0.0, -1.0]),  # heading east
    ],
)
def test_a_resting_accelerometer_feels_the_ground(
    quaternion: list[float], force: list[float]
) -> None:
    expected = GRAVITY_MPS2 * np.array(force)
    np.testing.assert_allclose(_felt(_at_rest(quaternion)), expected, atol=0.005)


def test_the_magnetometer_turns_with_the_vehicle() -> None:
    east, sensors = _at_rest([QUARTER, 0.0, 0.0, QUARTER]), Sensors(7)
    north_gauss, east_gauss, down_gauss = FIELD_NED_GAUSS
    samples = np.array([sensors.magnetic_field(east) for _ in range(1000)])
    expected = [east_gauss, -north_gauss, down_gauss]
    np.testing.assert_allclose(samples.mean(axis=0), expected, atol=1e-4)
    assert samples.std(axis=0) == pytest.approx([MAGNETOMETER_GAUSS] * 3, rel=0.1)


def test_the_barometer_is_at_the_origins_height() -> None:
    sensors = Sensors(7)
    pressure, altitude_m = np.mean([sensors.barometer(LEVEL) for _ in range(4000)], axis=0)
    assert pressure == pytest.approx(95_575.0, rel=1e-3)
    assert altitude_m == pytest.approx(489.4, abs=0.01)


def test_noise_has_its_size_and_no_bias() -> None:
    sensors = Sensors(7)
    samples = np.array([sensors.barometer(LEVEL)[0] for _ in range(4000)])
    assert samples.std() == pytest.approx(BAROMETER_PA, rel=0.05)
    fixes = [sensors.fix(LEVEL) for _ in range(2000)]
    places = np.array([Origin().local(*fix[:2]) for fix in fixes])
    assert places.std(axis=0) == pytest.approx([FIX_HORIZONTAL_M] * 2, rel=0.1)
    assert np.abs(places.mean(axis=0)).max() < 0.03


def test_a_seed_repeats_its_measurements() -> None:
    first, again, other = Sensors(1), Sensors(1), Sensors(2)
    np.testing.assert_array_equal(first.inertial(LEVEL), again.inertial(LEVEL))
    assert first.barometer(LEVEL) == again.barometer(LEVEL) != other.barometer(LEVEL)


def test_a_falling_vehicle_weighs_nothing() -> None:
    vehicle = Quadrotor(load_profile("solo"), position_enu_m=(0.0, 0.0, 50.0), yaw_enu_rad=0.0)
    for _ in range(10):
        vehicle.drive(np.zeros(4), armed=False)
    assert np.linalg.norm(_felt(vehicle.truth)) < 0.05
