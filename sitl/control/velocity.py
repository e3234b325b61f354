"""Outer loops: position to velocity, velocity to acceleration through a reference model.

The reference model is what the vehicle can do: it follows the velocity setpoint with limited
acceleration and the lag of the attitude loop. Its acceleration is fed forward, and the
feedback only sees what the vehicle does differently from it. So a step of the setpoint neither
overshoots nor winds up the integral.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.control.compiled import compiled
from sitl.control.layout import (
    G_ACCELERATION_LIMIT,
    G_CLIMB_LIMIT,
    G_DESCENT_LIMIT,
    G_DT,
    G_INTEGRAL_LIMIT,
    G_MODEL_LAG,
    G_MODEL_P,
    G_POSITION_P,
    G_SPEED_LIMIT,
    G_VELOCITY_I,
    G_VELOCITY_P,
    M_POSITION,
    M_VELOCITY,
    S_MODEL_ACCELERATION,
    S_MODEL_VELOCITY,
    S_VELOCITY_INTEGRAL,
    SP_ACCELERATION,
    SP_POSITION,
    SP_VELOCITY,
)
from sitl.control.setpoint import clip, limit_horizontal

Vector = NDArray[np.float64]


@compiled
def velocity_target(clean: Vector, measurement: Vector, gains: Vector) -> Vector:
    """Velocity to fly (3,), NED m/s: position error times gain, plus the velocity setpoint.

    An axis with neither position nor velocity has target zero, unless it has an acceleration:
    then it is NaN, which means that the acceleration alone steers it.
    """
    target = np.empty(3)
    for axis in range(3):
        position = clean[SP_POSITION + axis]
        velocity = clean[SP_VELOCITY + axis]
        if math.isfinite(position):
            error = position - measurement[M_POSITION + axis]
            target[axis] = gains[G_POSITION_P + axis] * error
            if math.isfinite(velocity):
                target[axis] += velocity
        elif math.isfinite(velocity):
            target[axis] = velocity
        elif math.isfinite(clean[SP_ACCELERATION + axis]):
            target[axis] = math.nan
        else:
            target[axis] = 0.0
    limit_horizontal(target, 0, gains[G_SPEED_LIMIT])
    if math.isfinite(target[2]):
        target[2] = clip(target[2], -gains[G_CLIMB_LIMIT], gains[G_DESCENT_LIMIT])
    return target


@compiled
def model_acceleration(target: Vector, clean: Vector, state: Vector, gains: Vector) -> Vector:
    """Acceleration (3,) that takes the reference model to its target, NED m/s^2, limited."""
    wanted = np.empty(3)
    for axis in range(3):
        forward = clean[SP_ACCELERATION + axis]
        wanted[axis] = forward if math.isfinite(forward) else 0.0
        if math.isfinite(target[axis]):
            wanted[axis] += gains[G_MODEL_P + axis] * (
                target[axis] - state[S_MODEL_VELOCITY + axis]
            )
    limit_horizontal(wanted, 0, gains[G_ACCELERATION_LIMIT])
    limit = gains[G_ACCELERATION_LIMIT + 1]
    wanted[2] = clip(wanted[2], -limit, limit)
    return wanted


@compiled
def acceleration_target(
    target: Vector, clean: Vector, measurement: Vector, state: Vector, gains: Vector
) -> Vector:
    """Acceleration to fly (3,), NED m/s^2; moves the model and the integral in `state` on."""
    dt = gains[G_DT]
    wanted = model_acceleration(target, clean, state, gains)
    total = np.empty(3)
    for axis in range(3):
        measured = measurement[M_VELOCITY + axis]
        if not math.isfinite(target[axis]):
            state[S_MODEL_VELOCITY + axis] = measured
        share = dt / (gains[G_MODEL_LAG + axis] + dt)
        lagged = state[S_MODEL_ACCELERATION + axis]
        lagged += share * (wanted[axis] - lagged)
        state[S_MODEL_ACCELERATION + axis] = lagged
        error = state[S_MODEL_VELOCITY + axis] - measured
        state[S_MODEL_VELOCITY + axis] += dt * lagged
        limit = gains[G_INTEGRAL_LIMIT + axis]
        integral = state[S_VELOCITY_INTEGRAL + axis] + dt * gains[G_VELOCITY_I + axis] * error
        state[S_VELOCITY_INTEGRAL + axis] = clip(integral, -limit, limit)
        total[axis] = (
            wanted[axis] + gains[G_VELOCITY_P + axis] * error + state[S_VELOCITY_INTEGRAL + axis]
        )
    return total
