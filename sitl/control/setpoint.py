"""Cleans a setpoint so that it cannot corrupt the controller state."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from sitl.control.layout import (
    G_ACCELERATION_LIMIT,
    G_CLIMB_LIMIT,
    G_DESCENT_LIMIT,
    G_SPEED_LIMIT,
    G_YAW_RATE_LIMIT,
    SETPOINT_SIZE,
    SP_ACCELERATION,
    SP_POSITION,
    SP_VELOCITY,
    SP_YAW,
    SP_YAW_RATE,
)

Vector = NDArray[np.float64]

FARTHEST_M = 1.0e5
LARGEST_ANGLE_RAD = 1.0e4
LARGEST_INPUT = 1.0e3  # limit of a velocity or acceleration component before the norm's limit


@compiled
def clip(value: float, low: float, high: float) -> float:
    """Clip `value` to [low, high]."""
    return min(max(value, low), high)


@compiled
def wrap(angle_rad: float) -> float:
    """Wrap an angle into [-pi, pi), rad."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def finite_or_nan(value: float, limit: float) -> float:
    """Clip `value` to +-limit. Return NaN if it is not finite."""
    if not math.isfinite(value):
        return math.nan
    return min(max(value, -limit), limit)


@compiled
def limit_horizontal(vector: Vector, start: int, limit: float) -> None:
    """Limit the norm of vector[start:start + 2] to `limit`. NaN counts as zero."""
    x = vector[start] if math.isfinite(vector[start]) else 0.0
    y = vector[start + 1] if math.isfinite(vector[start + 1]) else 0.0
    norm = math.sqrt(x * x + y * y)
    if norm > limit:
        vector[start] *= limit / norm
        vector[start + 1] *= limit / norm


@compiled
def clean_setpoint(setpoint: Vector, gains: Vector) -> Vector:
    """Return a copy (11,) within the vehicle's limits, with NaN for values that are not finite.

    Velocity is limited to the horizontal speed (norm) and to the climb and descent limits,
    acceleration and yaw rate to their limits, and yaw to [-pi, pi).
    """
    clean = np.empty(SETPOINT_SIZE)
    for axis in range(3):
        clean[SP_POSITION + axis] = finite_or_nan(setpoint[SP_POSITION + axis], FARTHEST_M)
        clean[SP_VELOCITY + axis] = finite_or_nan(setpoint[SP_VELOCITY + axis], LARGEST_INPUT)
        clean[SP_ACCELERATION + axis] = finite_or_nan(
            setpoint[SP_ACCELERATION + axis], LARGEST_INPUT
        )
    limit_horizontal(clean, SP_VELOCITY, gains[G_SPEED_LIMIT])
    limit_horizontal(clean, SP_ACCELERATION, gains[G_ACCELERATION_LIMIT])
    down = SP_VELOCITY + 2
    if math.isfinite(clean[down]):
        clean[down] = clip(clean[down], -gains[G_CLIMB_LIMIT], gains[G_DESCENT_LIMIT])
    down = SP_ACCELERATION + 2
    clean[down] = finite_or_nan(clean[down], gains[G_ACCELERATION_LIMIT + 1])
    clean[SP_YAW] = wrap(finite_or_nan(setpoint[SP_YAW], LARGEST_ANGLE_RAD))
    clean[SP_YAW_RATE] = finite_or_nan(setpoint[SP_YAW_RATE], gains[G_YAW_RATE_LIMIT])
    return clean
