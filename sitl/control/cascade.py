"""One control step from setpoint and measurement to motor commands."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from sitl.control.attitude import heading_rate, rotation, specific_force, tilt_rates, torque, unwind
from sitl.control.layout import (
    G_MASS,
    M_ON_GROUND,
    M_RATES,
    M_VELOCITY,
    S_FLYING,
    S_HEADING,
    S_LAST_RATES,
    S_MODEL_VELOCITY,
    STATE_SIZE,
)
from sitl.control.mixer import idle, mix
from sitl.control.setpoint import clean_setpoint
from sitl.control.velocity import acceleration_target, velocity_target

Vector = NDArray[np.float64]

LIFT_OFF_MPS = 0.1  # minimum climb setpoint for lift-off


@compiled
def resting_state(measurement: Vector, matrix: Vector) -> Vector:
    """Return the controller state (n,) on the ground: zero integrals, references at rest."""
    state = np.zeros(STATE_SIZE)
    state[S_HEADING] = math.atan2(matrix[1, 0], matrix[0, 0])
    for axis in range(3):
        state[S_MODEL_VELOCITY + axis] = measurement[M_VELOCITY + axis]
        state[S_LAST_RATES + axis] = measurement[M_RATES + axis]
    return state


@compiled
def control_step(
    state: Vector, measurement: Vector, setpoint: Vector, gains: Vector, armed: bool
) -> tuple[Vector, Vector]:
    """Return the next controller state (18,) and the motor commands (4,) in [0, 1].

    The function is pure and does not change `state`. Arrays have the layout of
    sitl.control.layout. An armed vehicle on the ground idles until the setpoint climbs, and idles
    again after touchdown.
    """
    matrix = rotation(measurement)
    if not armed:
        return resting_state(measurement, matrix), np.zeros(4)
    clean = clean_setpoint(setpoint, gains)
    target = velocity_target(clean, measurement, gains)
    on_ground = measurement[M_ON_GROUND] > 0.5
    climbing = target[2] < -LIFT_OFF_MPS
    if on_ground and not climbing:
        return resting_state(measurement, matrix), idle(gains)
    new = state.copy() if state[S_FLYING] > 0.5 else resting_state(measurement, matrix)
    new[S_FLYING] = 1.0
    acceleration = acceleration_target(target, clean, measurement, new, gains)
    force = specific_force(acceleration, gains)
    unwind(acceleration, force, new, gains)
    rates = tilt_rates(force, matrix, gains)
    heading = math.atan2(matrix[1, 0], matrix[0, 0])
    turn = heading_rate(clean, heading, new, gains)
    for axis in range(3):
        rates[axis] += matrix[2, axis] * turn
    moment = torque(rates, measurement, new, gains, not on_ground)
    lift = -(matrix[0, 2] * force[0] + matrix[1, 2] * force[1] + matrix[2, 2] * force[2])
    return new, mix(gains[G_MASS] * max(lift, 0.0), moment, gains)
