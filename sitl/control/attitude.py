"""Inner loops from acceleration to thrust vector, to body rates, to torque."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from sitl.control.layout import (
    G_DT,
    G_GRAVITY,
    G_HEADING_MODEL_P,
    G_HEADING_P,
    G_INERTIA,
    G_MASS,
    G_RATE_D,
    G_RATE_I,
    G_RATE_P,
    G_ROTOR_THRUST,
    G_TILT_P,
    G_TILT_RATE_LIMIT,
    G_TILT_TANGENT,
    G_YAW_ACCELERATION,
    G_YAW_RATE_LIMIT,
    M_QUATERNION,
    M_RATES,
    S_HEADING,
    S_HEADING_RATE,
    S_LAST_RATES,
    S_RATE_INTEGRAL,
    S_VELOCITY_INTEGRAL,
    SP_YAW,
    SP_YAW_RATE,
)
from sitl.control.setpoint import clip, wrap

Vector = NDArray[np.float64]

LEAST_LIFT = 0.25  # fraction of gravity; with less lift the attitude is undefined
THRUST_RESERVE = 0.9  # fraction of the maximum thrust; the rest is reserved for attitude
HORIZONTAL_MARGIN = 0.2  # fraction of gravity reserved for horizontal acceleration
UNWINDING_HZ = 2.0  # rate at which an integral unwinds at a limit
RATE_INTEGRAL_LIMIT_RADPS2 = 20.0


@compiled
def rotation(measurement: Vector) -> Vector:
    """Return the rotation matrix (3, 3), body FRD -> NED, of the measured attitude."""
    w, x, y, z = measurement[M_QUATERNION : M_QUATERNION + 4]
    matrix = np.empty((3, 3))
    matrix[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    matrix[0, 1] = 2.0 * (x * y - w * z)
    matrix[0, 2] = 2.0 * (x * z + w * y)
    matrix[1, 0] = 2.0 * (x * y + w * z)
    matrix[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    matrix[1, 2] = 2.0 * (y * z - w * x)
    matrix[2, 0] = 2.0 * (x * z - w * y)
    matrix[2, 1] = 2.0 * (y * z + w * x)
    matrix[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return matrix


@compiled
def specific_force(acceleration: Vector, gains: Vector) -> Vector:
    """Return the thrust per mass (3,), NED m/s^2, for an acceleration, with priority for height.

    The vertical part has priority, except for a margin. The horizontal part is reduced to the tilt
    limit and to the available thrust.
    """
    gravity = gains[G_GRAVITY]
    largest = THRUST_RESERVE * 4.0 * gains[G_ROTOR_THRUST] / gains[G_MASS]
    horizontal = math.sqrt(acceleration[0] ** 2 + acceleration[1] ** 2)
    margin = min(horizontal, HORIZONTAL_MARGIN * gravity)
    highest = math.sqrt(max(largest * largest - margin * margin, 0.0))
    force = np.empty(3)
    force[2] = clip(acceleration[2] - gravity, -highest, -LEAST_LIFT * gravity)
    room = math.sqrt(max(largest * largest - force[2] * force[2], 0.0))
    allowed = min(-force[2] * gains[G_TILT_TANGENT], room)
    scale = allowed / horizontal if horizontal > allowed else 1.0
    force[0] = acceleration[0] * scale
    force[1] = acceleration[1] * scale
    return force


@compiled
def unwind(acceleration: Vector, force: Vector, state: Vector, gains: Vector) -> None:
    """Unwind the velocity integrals in `state` that push into a limit."""
    for axis in range(3):
        had = force[axis] + (gains[G_GRAVITY] if axis == 2 else 0.0)
        step = gains[G_DT] * UNWINDING_HZ * abs(had - acceleration[axis])
        integral = state[S_VELOCITY_INTEGRAL + axis]
        if integral * (acceleration[axis] - had) > 0.0:
            left = max(abs(integral) - step, 0.0)
            state[S_VELOCITY_INTEGRAL + axis] = math.copysign(left, integral)


@compiled
def tilt_rates(force: Vector, matrix: Vector, gains: Vector) -> Vector:
    """Return the body rates (3,), rad/s, without yaw, that turn the thrust axis to the force."""
    norm = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    # target down axis in body coordinates
    x = -(matrix[0, 0] * force[0] + matrix[1, 0] * force[1] + matrix[2, 0] * force[2]) / norm
    y = -(matrix[0, 1] * force[0] + matrix[1, 1] * force[1] + matrix[2, 1] * force[2]) / norm
    z = -(matrix[0, 2] * force[0] + matrix[1, 2] * force[1] + matrix[2, 2] * force[2]) / norm
    sine = math.sqrt(x * x + y * y)
    angle = math.atan2(sine, z)
    rate = min(gains[G_TILT_P] * angle, gains[G_TILT_RATE_LIMIT])
    rates = np.zeros(3)
    if sine > 1.0e-12:
        rates[0] = -rate * y / sine
        rates[1] = rate * x / sine
    elif z < 0.0:
        rates[0] = rate
    return rates


@compiled
def heading_rate(clean: Vector, heading: float, state: Vector, gains: Vector) -> float:
    """Return the yaw rate round the vertical, rad/s, and advance the heading reference."""
    dt = gains[G_DT]
    limit = gains[G_YAW_RATE_LIMIT]
    wanted = clean[SP_YAW_RATE] if math.isfinite(clean[SP_YAW_RATE]) else 0.0
    if math.isfinite(clean[SP_YAW]):
        error = wrap(clean[SP_YAW] - state[S_HEADING])
        brake = math.sqrt(1.6 * gains[G_YAW_ACCELERATION] * abs(error))
        wanted += math.copysign(min(gains[G_HEADING_MODEL_P] * abs(error), brake), error)
    wanted = clip(wanted, -limit, limit)
    step = dt * gains[G_YAW_ACCELERATION]
    rate: float = state[S_HEADING_RATE]
    rate += clip(wanted - rate, -step, step)
    state[S_HEADING_RATE] = rate
    state[S_HEADING] = wrap(state[S_HEADING] + dt * rate)
    correction: float = gains[G_HEADING_P] * wrap(state[S_HEADING] - heading)
    return rate + clip(correction, -limit, limit)


@compiled
def torque(
    rates_wanted: Vector, measurement: Vector, state: Vector, gains: Vector, yaw_free: bool
) -> Vector:
    """Return the body torque (3,), N m, of the rate loops, and advance their integrals.

    The loops are PID with the derivative of the measurement, scaled by inertia, plus the gyroscopic
    term.
    """
    dt = gains[G_DT]
    angular = np.empty(3)
    for axis in range(3):
        rate = measurement[M_RATES + axis]
        error = rates_wanted[axis] - rate
        derivative = (rate - state[S_LAST_RATES + axis]) / dt
        state[S_LAST_RATES + axis] = rate
        if axis < 2 or yaw_free:
            integral = state[S_RATE_INTEGRAL + axis] + dt * gains[G_RATE_I + axis] * error
            state[S_RATE_INTEGRAL + axis] = clip(
                integral, -RATE_INTEGRAL_LIMIT_RADPS2, RATE_INTEGRAL_LIMIT_RADPS2
            )
        angular[axis] = (
            gains[G_RATE_P + axis] * error
            + state[S_RATE_INTEGRAL + axis]
            - gains[G_RATE_D + axis] * derivative
        )
    p, q, r = measurement[M_RATES : M_RATES + 3]
    ix, iy, iz = gains[G_INERTIA : G_INERTIA + 3]
    result = np.empty(3)
    result[0] = ix * angular[0] + q * r * (iz - iy)
    result[1] = iy * angular[1] + p * r * (ix - iz)
    result[2] = iz * angular[2] + p * q * (iy - ix)
    return result
