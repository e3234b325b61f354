"""A vehicle under test with a recorder."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from sitl.vehicle.profile import load_profile
from sitl.vehicle.truth import T_POSITION, T_QUATERNION, T_VELOCITY
from sitl.vehicle.vehicle import PHYSICS_DT_S, Quadrotor

FREE = math.nan


def make_setpoint(
    *,
    position=(FREE, FREE, FREE),
    velocity=(FREE, FREE, FREE),
    acceleration=(FREE, FREE, FREE),
    yaw=FREE,
    yaw_rate=FREE,
    thrust=FREE,
    attitude=(FREE,) * 4,
    body_rates=(FREE,) * 3,
):
    followed = *position, *velocity, *acceleration, yaw, yaw_rate
    return np.array([*followed, thrust, *attitude, *body_rates], dtype=np.float64)


class Record:
    """The truth of a flight, one row a step."""

    def __init__(self, rows):
        self.rows = np.array(rows)
        self.position = self.rows[:, T_POSITION : T_POSITION + 3]
        self.velocity = self.rows[:, T_VELOCITY : T_VELOCITY + 3]
        self.quaternion = self.rows[:, T_QUATERNION : T_QUATERNION + 4]
        self.time_s = np.arange(1, len(self.rows) + 1) * PHYSICS_DT_S

    @property
    def heading(self):
        w, x, y, z = self.quaternion.T
        return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def tilt_deg(self):
        _w, x, y, _z = self.quaternion.T
        return np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))

    def settling_s(self, error, band):
        """When `error` last left the band."""
        outside = np.flatnonzero(error > band)
        return self.time_s[outside[-1]] if len(outside) else 0.0


class Flight:
    """A vehicle, "profile" or "profile+payload in kg", and what to do with it."""

    def __init__(self, name, *, position_enu_m=(0.0, 0.0, 0.0), yaw_enu_rad=0.5):
        base, _, payload_kg = name.partition("+")
        payload_kg = float(payload_kg or 0.0)
        profile = dataclasses.replace(load_profile(base), extra_payload_kg=payload_kg)
        self.vehicle = Quadrotor(profile, position_enu_m=position_enu_m, yaw_enu_rad=yaw_enu_rad)
        self.truth = self.vehicle.truth

    def fly(self, setpoint, seconds, *, armed=True):
        rows = []
        for step in range(round(seconds / PHYSICS_DT_S)):
            now = setpoint(step * PHYSICS_DT_S) if isinstance(setpoint, Callable) else setpoint
            self.vehicle.step(now, armed)
            rows.append(self.truth.flat.copy())
        return Record(rows)

    def take_off(self):
        self.fly(make_setpoint(velocity=(0.0, 0.0, -2.0)), 4.0)
        self.fly(make_setpoint(velocity=(0.0, 0.0, 0.0)), 3.0)
        return self


@pytest.fixture
def setpoint():
    return make_setpoint


@pytest.fixture
def grounded():
    return Flight


@pytest.fixture
def airborne():
    return lambda name: Flight(name).take_off()
