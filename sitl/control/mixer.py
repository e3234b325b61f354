"""Mixer from collective thrust and torque to four motor commands, with desaturation.

Rotors are in PX4's order for an X frame: front right, rear left, front left, rear right. The first
two turn counter-clockwise seen from above.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from sitl.control.layout import (
    G_ROTOR_OFFSET,
    G_ROTOR_THRUST,
    G_THROTTLE,
    G_TORQUE_PER_THRUST,
)
from sitl.control.setpoint import clip

Vector = NDArray[np.float64]

LEAST_SHARE = 0.01  # minimum share of a rotor's thrust, which keeps it turning
IDLE_SHARE = 0.01
NEGLIGIBLE_SHARE = 1.0e-12  # smallest divisor
_FORWARD = np.array([1.0, -1.0, 1.0, -1.0])
_RIGHT = np.array([1.0, -1.0, -1.0, 1.0])
_SENSE = np.array([1.0, 1.0, -1.0, -1.0])


@compiled
def thrust_shares(collective_n: float, torque_nm: Vector, gains: Vector) -> Vector:
    """Return each rotor's thrust (4,) as a share of its maximum, within [LEAST_SHARE, 1].

    If the rotors saturate, roll and pitch have priority, then the collective, then yaw.
    """
    unit = 4.0 * gains[G_ROTOR_THRUST]
    arm = unit * gains[G_ROTOR_OFFSET]
    tilting = (_FORWARD * torque_nm[1] - _RIGHT * torque_nm[0]) / arm
    room = 1.0 - LEAST_SHARE
    spread = tilting.max() - tilting.min()
    if spread > room:
        tilting *= room / spread
    base = clip(collective_n / unit, LEAST_SHARE - tilting.min(), 1.0 - tilting.max())
    shares: Vector = tilting + base
    yawing = _SENSE * torque_nm[2] / (unit * gains[G_TORQUE_PER_THRUST])
    scale = 1.0
    for rotor in range(4):
        if yawing[rotor] > NEGLIGIBLE_SHARE:
            scale = min(scale, (1.0 - shares[rotor]) / yawing[rotor])
        elif yawing[rotor] < -NEGLIGIBLE_SHARE:
            scale = min(scale, (LEAST_SHARE - shares[rotor]) / yawing[rotor])
    shares += max(scale, 0.0) * yawing
    for rotor in range(4):
        shares[rotor] = clip(shares[rotor], LEAST_SHARE, 1.0)
    return shares


@compiled
def throttle(share: float, gains: Vector) -> float:
    """Return the motor command in [0, 1] for a static thrust share: voltage = V(rotor speed)."""
    speed = math.sqrt(share)
    command = gains[G_THROTTLE] + gains[G_THROTTLE + 1] * speed + gains[G_THROTTLE + 2] * share
    return clip(command, 0.0, 1.0)


@compiled
def mix(collective_n: float, torque_nm: Vector, gains: Vector) -> Vector:
    """Return motor commands (4,) in [0, 1] for collective thrust, N, and torque (3,), N m."""
    commands = thrust_shares(collective_n, torque_nm, gains)
    for rotor in range(4):
        commands[rotor] = throttle(commands[rotor], gains)
    return commands


@compiled
def idle(gains: Vector) -> Vector:
    """Return the motor commands (4,) of an armed vehicle on the ground."""
    return np.full(4, throttle(IDLE_SHARE, gains))
