"""What the autopilot reads of the vehicle: a perfect estimator."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Truth(Protocol):
    """The vehicle's state at one stamp; NED and FRD, SI units."""

    stamp_s: float
    position_ned_m: Vector  # (3,)
    velocity_ned_mps: Vector  # (3,)
    acceleration_ned_mps2: Vector  # (3,)
    quaternion_frd_ned: Vector  # (4,) w x y z, body FRD -> NED
    rates_frd_radps: Vector  # (3,)
    motor_commands: Vector  # (4,) 0..1
    on_ground: bool
    battery_voltage_v: float
    battery_current_a: float
    battery_remaining: float  # 0..1
