"""Interface of a flight mode's guidance, and the functions that modes share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sitl.autopilot.parameters import Parameters
from sitl.autopilot.setpoint import Setpoint
from sitl.autopilot.truth import StateEstimate, Vector

POSITION_GAIN_PER_S = 0.95  # MPC_XY_P of PX4
_CLIMB_MPS = 0.3  # minimum climb speed of a setpoint that leaves the ground
_CLIMB_M = 0.3
_STOPPED_MPS = 0.3


@dataclass(slots=True, kw_only=True)
class Situation:
    """Inputs of a flight mode at one tick."""

    truth: StateEstimate
    dt_s: float
    parameters: Parameters
    landed: bool
    spooled_up: bool  # armed for long enough to take off
    home_ned_m: Vector  # (3,)
    heading_rad: float


class Guidance(Protocol):
    """Guidance of a flight mode from one entry to its end."""

    def fly(self, now: Situation, out: Setpoint) -> None:
        """Write the setpoint of this tick into `out`, which holds NaN."""


def climbs(out: Setpoint, truth: StateEstimate) -> bool:
    """Return True if a setpoint climbs; NaN does not."""
    lift = out[2] - truth.position_ned_m[2]
    return bool(out[5] < -_CLIMB_MPS or lift < -_CLIMB_M)


def approach(delta: Vector, *, speed_mps: float, acceleration_mps2: float) -> Vector:
    """Return a velocity (n,) towards a point at a distance `delta` (n,) that allows a stop there.

    It is the minimum of the limit, sqrt(2 a d) with half the acceleration, and the position loop.
    """
    distance = math.sqrt(float(delta @ delta))
    if distance < 1e-6:
        return np.zeros_like(delta)
    stopping = math.sqrt(acceleration_mps2 * distance)
    return delta * (min(speed_mps, stopping, POSITION_GAIN_PER_S * distance) / distance)


def limit_velocity(out: Setpoint, parameters: Parameters) -> None:
    """Limit the velocity of a setpoint to MPC_XY_VEL_MAX and MPC_Z_VEL_MAX_*, in place."""
    speed = math.hypot(out[3], out[4])
    fastest = parameters.effective("MPC_XY_VEL_MAX")
    if speed > fastest:
        out[3:5] *= fastest / speed
    up, down = parameters.effective("MPC_Z_VEL_MAX_UP"), parameters.effective("MPC_Z_VEL_MAX_DN")
    if out[5] < -up:
        out[5] = -up
    elif out[5] > down:
        out[5] = down


class Anchor:
    """A position hold that brakes first, then keeps the point of rest."""

    __slots__ = ("_axes", "_place")

    def __init__(self, axes: slice, place: Vector | None = None) -> None:
        self._axes = axes
        self._place = place

    def hold(self, now: Situation, out: Setpoint) -> None:
        """Write position, or zero velocity while braking, for the anchor's axes."""
        axes = self._axes
        if self._place is None:
            velocity = now.truth.velocity_ned_mps[axes]
            if float(velocity @ velocity) > _STOPPED_MPS**2:
                out[3:6][axes] = 0.0
                return
            self._place = np.array(now.truth.position_ned_m[axes])
        out[0:3][axes] = self._place


HORIZONTAL = slice(0, 2)
ALL_AXES = slice(0, 3)
