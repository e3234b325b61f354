"""What the autopilot reads of the vehicle: a perfect estimator."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Truth(Protocol):
    """The vehicle's state at one stamp; NED and FRD, SI units."""

    @property
    def position_ned_m(self) -> Vector:
        """Of the centre of mass (3,)."""

    @property
    def velocity_ned_mps(self) -> Vector:
        """(3,)."""

    @property
    def acceleration_ned_mps2(self) -> Vector:
        """(3,), gravity not included."""

    @property
    def quaternion_frd_ned(self) -> Vector:
        """(4,) w x y z, body FRD -> NED."""

    @property
    def rates_frd_radps(self) -> Vector:
        """(3,)."""

    @property
    def motor_commands(self) -> Vector:
        """(4,) 0..1."""

    @property
    def on_ground(self) -> bool:
        """Whether a leg carries weight."""

    @property
    def battery_voltage_v(self) -> float:
        """At the terminals."""

    @property
    def battery_current_a(self) -> float:
        """Drawn."""

    @property
    def battery_remaining(self) -> float:
        """Charge left, 0..1."""
