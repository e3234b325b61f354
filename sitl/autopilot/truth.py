"""The vehicle state that the autopilot reads, as from a perfect estimator."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class StateEstimate(Protocol):
    """State of the vehicle at one stamp, in NED and FRD, SI units."""

    @property
    def position_ned_m(self) -> Vector:
        """Position of the centre of mass (3,)."""

    @property
    def velocity_ned_mps(self) -> Vector:
        """(3,)."""

    @property
    def acceleration_ned_mps2(self) -> Vector:
        """Acceleration (3,) without gravity."""

    @property
    def quaternion_frd_ned(self) -> Vector:
        """Attitude (4,) w x y z, body FRD -> NED."""

    @property
    def rates_frd_radps(self) -> Vector:
        """(3,)."""

    @property
    def motor_commands(self) -> Vector:
        """Motor commands (4,), 0..1."""

    @property
    def on_ground(self) -> bool:
        """True if a landing leg carries weight."""

    @property
    def battery_voltage_v(self) -> float:
        """Voltage at the terminals."""

    @property
    def battery_current_a(self) -> float:
        """Drawn."""

    @property
    def battery_remaining(self) -> float:
        """Remaining charge, 0..1."""
