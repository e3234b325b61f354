"""Simulates the sensors of a vehicle, which measure its true state with seeded noise."""

from __future__ import annotations

import math

import numpy as np

from mavfi_cli.core.frames import Vector
from sitl.geodesy import Origin, pressure_altitude_m, standard_pressure_pa
from sitl.vehicle.profile import GRAVITY_MPS2
from sitl.vehicle.truth import Truth

# Standard deviations of white noise, about as large as in PX4's own simulated sensors.
GYRO_RADPS = 0.003
ACCELEROMETER_MPS2 = 0.03
MAGNETOMETER_GAUSS = 0.0004
BAROMETER_PA = 1.0
FIX_HORIZONTAL_M = 0.2
FIX_VERTICAL_M = 0.5
FIX_SPEED_MPS = 0.06

# The magnetic field near Zurich from the World Magnetic Model: declination, inclination, strength.
_DECLINATION_RAD = math.radians(3.19)
_INCLINATION_RAD = math.radians(63.1)
_STRENGTH_GAUSS = 0.4816
_LEVEL_SHARE = math.cos(_INCLINATION_RAD)
_NORTH, _EAST = _LEVEL_SHARE * math.cos(_DECLINATION_RAD), _LEVEL_SHARE * math.sin(_DECLINATION_RAD)
FIELD_NED_GAUSS = _STRENGTH_GAUSS * np.array([_NORTH, _EAST, math.sin(_INCLINATION_RAD)])
_GRAVITY_NED_MPS2 = np.array([0.0, 0.0, GRAVITY_MPS2])


class Sensors:
    """Gyroscope, accelerometer, magnetometer, barometer and GPS of one vehicle.

    The same seed and the same calls give the same measurements.
    """

    def __init__(self, seed: int) -> None:
        self._noise = np.random.default_rng(seed)
        self._origin = Origin()

    def inertial(self, truth: Truth) -> tuple[Vector, Vector]:
        """Return the measured rates (3,), rad/s, and specific force (3,), m/s^2, in body FRD."""
        noise = self._noise.standard_normal(6)
        rates = truth.rates_frd_radps + GYRO_RADPS * noise[:3]
        force = truth.in_body(truth.acceleration_ned_mps2 - _GRAVITY_NED_MPS2)
        return rates, force + ACCELEROMETER_MPS2 * noise[3:]

    def magnetic_field(self, truth: Truth) -> Vector:
        """Return the measured magnetic field (3,) in gauss, in body FRD."""
        field = truth.in_body(FIELD_NED_GAUSS)
        return field + MAGNETOMETER_GAUSS * self._noise.standard_normal(3)

    def barometer(self, truth: Truth) -> tuple[float, float]:
        """Return the measured air pressure, Pa, and the altitude above sea level, m, for it."""
        altitude_m = self._origin.altitude_amsl_m - float(truth.position_ned_m[2])
        noise_pa = BAROMETER_PA * float(self._noise.standard_normal())
        pressure_pa = standard_pressure_pa(altitude_m) + noise_pa
        return pressure_pa, pressure_altitude_m(pressure_pa)

    def fix(self, truth: Truth) -> tuple[float, float, float, Vector]:
        """Return a GPS fix: latitude, longitude, altitude and velocity.

        Latitude and longitude are in degrees, the altitude is in metres above sea level, and the
        velocity (3,) is in NED m/s.
        """
        noise = self._noise.standard_normal(6)
        north, east, down = truth.position_ned_m.tolist()
        latitude, longitude = self._origin.geodetic(
            north + FIX_HORIZONTAL_M * noise[0], east + FIX_HORIZONTAL_M * noise[1]
        )
        altitude_m = self._origin.altitude_amsl_m - down + FIX_VERTICAL_M * noise[2]
        return latitude, longitude, altitude_m, truth.velocity_ned_mps + FIX_SPEED_MPS * noise[3:]
