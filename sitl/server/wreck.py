"""State of a vehicle that has crashed and come to rest."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sitl.autopilot.truth import StateEstimate, Vector

_GROUND_M = 0.3  # highest centre of a fallen vehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class Wreck:
    """State of a vehicle at permanent rest; see `sitl.autopilot.truth.StateEstimate`."""

    position_ned_m: Vector  # (3,)
    quaternion_frd_ned: Vector  # (4,)
    battery_voltage_v: float
    battery_remaining: float
    battery_current_a: float = 0.0
    on_ground: bool = True
    velocity_ned_mps: Vector = field(default_factory=lambda: np.zeros(3))
    acceleration_ned_mps2: Vector = field(default_factory=lambda: np.zeros(3))
    rates_frd_radps: Vector = field(default_factory=lambda: np.zeros(3))
    motor_commands: Vector = field(default_factory=lambda: np.zeros(4))


def has_come_down(truth: StateEstimate) -> bool:
    """Whether a vehicle without motors has reached the ground."""
    return truth.on_ground or bool(truth.position_ned_m[2] > -_GROUND_M)


def wreck_of(truth: StateEstimate) -> Wreck:
    """The state of a vehicle that stays at its position."""
    return Wreck(
        position_ned_m=np.array(truth.position_ned_m),
        quaternion_frd_ned=np.array(truth.quaternion_frd_ned),
        battery_voltage_v=truth.battery_voltage_v,
        battery_remaining=truth.battery_remaining,
    )
