"""What a flight mode reads and writes, and the little arithmetic that modes share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sitl.autopilot.parameters import Parameters
from sitl.autopilot.setpoint import Setpoint
from sitl.autopilot.truth import Truth, Vector

POSITION_GAIN_PER_S = 0.95  # MPC_XY_P of PX4
_CLIMB_MPS = 0.3  # a setpoint that asks for this much wants to leave the ground
_CLIMB_M = 0.3
_STOPPED_MPS = 0.3


@dataclass(slots=True, kw_only=True)
class Situation:
    """The vehicle as a flight mode sees it at one tick."""

    truth: Truth
    dt_s: float
    parameters: Parameters
    landed: bool
    spooled_up: bool  # armed for long enough to take off
    home_ned_m: Vector  # (3,)
    heading_rad: float


class Guidance(Protocol):
    """One entry into a flight mode, from entering to leaving it."""

    def fly(self, now: Situation, out: Setpoint) -> None:
        """Write the setpoint of this tick into `out`, which holds NaN."""


def climbs(out: Setpoint, truth: Truth) -> bool:
    """Whether a setpoint wants to go up; NaN wants nothing."""
    lift = out[2] - truth.position_ned_m[2]
    return bool(out[5] < -_CLIMB_MPS or lift < -_CLIMB_M)


def approach(delta: Vector, *, speed_mps: float, acceleration_mps2: float) -> Vector:
    """Velocity (n,) towards a point `delta` (n,) away that can stop there.

    The slowest of the limit, sqrt(2 a d) with half the acceleration, and the position loop.
    """
    distance = math.sqrt(float(delta @ delta))
    if distance < 1e-6:
        return np.zeros_like(delta)
    stopping = math.sqrt(acceleration_mps2 * distance)
    return delta * (min(speed_mps, stopping, POSITION_GAIN_PER_S * distance) / distance)


def limit_velocity(out: Setpoint, parameters: Parameters) -> None:
    """Hold the velocity of a setpoint inside MPC_XY_VEL_MAX and MPC_Z_VEL_MAX_*, in place."""
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
    """A place to stay at: brakes first, then keeps the point where it came to rest."""

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
