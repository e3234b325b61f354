"""Outer loops from position to velocity, and through a reference model to acceleration.

The reference model has the vehicle's capability: it follows the velocity setpoint with limited
acceleration and the lag of the attitude loop. Its acceleration is fed forward, and the feedback
acts only on the difference between vehicle and model. A setpoint step therefore neither overshoots
nor winds up the integral.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from sitl.control.layout import (
    G_ACCELERATION_LIMIT,
    G_CLIMB_LIMIT,
    G_DESCENT_LIMIT,
    G_DRAG_LINEAR,
    G_DRAG_QUADRATIC,
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
    S_LAGGED_FORWARD,
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
    """Return the target velocity (3,), NED m/s: gain times position error plus velocity setpoint.

    An axis with neither position nor velocity has target zero. If it has an acceleration, the
    target is NaN, which means that the acceleration alone controls it.
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
    """Return the limited acceleration (3,) of the reference model to its target, NED m/s^2.

    The velocity error excludes the part of the feed-forward that is delayed by the lag. A
    trajectory with its own acceleration is therefore followed one lag late, without overshoot.
    """
    wanted = np.empty(3)
    for axis in range(3):
        forward = clean[SP_ACCELERATION + axis]
        wanted[axis] = forward if math.isfinite(forward) else 0.0
        lag = gains[G_MODEL_LAG + axis]
        state[S_LAGGED_FORWARD + axis] += (wanted[axis] - state[S_LAGGED_FORWARD + axis]) * (
            gains[G_DT] / (lag + gains[G_DT])
        )
        if math.isfinite(target[axis]):
            reachable = target[axis] - lag * state[S_LAGGED_FORWARD + axis]
            error = reachable - state[S_MODEL_VELOCITY + axis]
            wanted[axis] += gains[G_MODEL_P + axis] * error
    limit_horizontal(wanted, 0, gains[G_ACCELERATION_LIMIT])
    limit = gains[G_ACCELERATION_LIMIT + 1]
    wanted[2] = clip(wanted[2], -limit, limit)
    return wanted


@compiled
def drag(velocity_mps: Vector, axis: int, gains: Vector) -> float:
    """Return the deceleration by drag and inflow along a NED axis at a velocity (3,), m/s^2."""
    v: float = velocity_mps[axis]
    slowing: float = gains[G_DRAG_LINEAR + axis] + gains[G_DRAG_QUADRATIC + axis] * abs(v)
    return v * slowing


@compiled
def acceleration_target(
    target: Vector, clean: Vector, measurement: Vector, state: Vector, gains: Vector
) -> Vector:
    """Return the target acceleration of the rotors (3,), NED m/s^2, and advance `state`.

    It is the feed-forward of the model's acceleration and of drag, plus P and a limited I of the
    difference between model and vehicle.
    """
    dt = gains[G_DT]
    wanted = model_acceleration(target, clean, state, gains)
    model = state[S_MODEL_VELOCITY : S_MODEL_VELOCITY + 3]
    total = np.empty(3)
    for axis in range(3):
        measured = measurement[M_VELOCITY + axis]
        if not math.isfinite(target[axis]):
            model[axis] = measured
        error = model[axis] - measured
        total[axis] = wanted[axis] + drag(model, axis, gains)
        total[axis] += gains[G_VELOCITY_P + axis] * error
        limit = gains[G_INTEGRAL_LIMIT + axis]
        integral = state[S_VELOCITY_INTEGRAL + axis] + dt * gains[G_VELOCITY_I + axis] * error
        state[S_VELOCITY_INTEGRAL + axis] = clip(integral, -limit, limit)
        total[axis] += state[S_VELOCITY_INTEGRAL + axis]
        share = dt / (gains[G_MODEL_LAG + axis] + dt)
        state[S_MODEL_ACCELERATION + axis] += share * (
            wanted[axis] - state[S_MODEL_ACCELERATION + axis]
        )
        model[axis] += dt * state[S_MODEL_ACCELERATION + axis]
    return total
