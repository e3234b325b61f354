"""True state of the vehicle at the end of a physics step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

T_STAMP = 0
T_POSITION = 1
T_VELOCITY = 4
T_ACCELERATION = 7
T_QUATERNION = 10
T_RATES = 14
T_COMMANDS = 17
T_RPM = 21
T_ON_GROUND = 25
T_VOLTAGE = 26
T_CURRENT = 27
T_REMAINING = 28
T_POWER_REGRESSION = 29
T_POWER_PROPELLER = 30
T_ENERGY_REGRESSION = 31
T_ENERGY_PROPELLER = 32
TRUTH_SIZE = 33


class Truth:
    """Read-only view of the newest state. It is updated in place, so copy values to keep them.

    The position is that of the centre of mass in the NED frame at the world origin on the ground.
    """

    __slots__ = (
        "acceleration_ned_mps2",
        "flat",
        "motor_commands",
        "motor_rpm",
        "position_ned_m",
        "quaternion_frd_ned",
        "rates_frd_radps",
        "velocity_ned_mps",
    )

    def __init__(self, flat: NDArray[np.float64]) -> None:
        view = flat.view()
        view.flags.writeable = False
        self.flat = view  # (TRUTH_SIZE,) all values in the order of the T_ constants
        self.position_ned_m = view[T_POSITION : T_POSITION + 3]  # (3,)
        self.velocity_ned_mps = view[T_VELOCITY : T_VELOCITY + 3]  # (3,)
        self.acceleration_ned_mps2 = view[T_ACCELERATION : T_ACCELERATION + 3]  # (3,)
        self.quaternion_frd_ned = view[T_QUATERNION : T_QUATERNION + 4]  # (4,) w x y z
        self.rates_frd_radps = view[T_RATES : T_RATES + 3]  # (3,)
        self.motor_commands = view[T_COMMANDS : T_COMMANDS + 4]  # (4,) 0..1
        self.motor_rpm = view[T_RPM : T_RPM + 4]  # (4,)

    @property
    def stamp_s(self) -> float:
        """Simulated time since the creation of the vehicle, s."""
        return float(self.flat[T_STAMP])

    @property
    def on_ground(self) -> bool:
        """True if a landing leg carries weight."""
        return bool(self.flat[T_ON_GROUND] > 0.5)

    @property
    def battery_voltage_v(self) -> float:
        """Voltage at the terminals, V."""
        return float(self.flat[T_VOLTAGE])

    @property
    def battery_current_a(self) -> float:
        """Battery current, A."""
        return float(self.flat[T_CURRENT])

    @property
    def battery_remaining(self) -> float:
        """Remaining charge, 0..1."""
        return float(self.flat[T_REMAINING])

    @property
    def power_regression_w(self) -> float:
        """Rotor power by the published regression, W; zero while disarmed."""
        return float(self.flat[T_POWER_REGRESSION])

    @property
    def power_propeller_w(self) -> float:
        """Shaft power of the propellers, W, summed over the rotors."""
        return float(self.flat[T_POWER_PROPELLER])

    @property
    def energy_regression_j(self) -> float:
        """Integral of `power_regression_w`, J."""
        return float(self.flat[T_ENERGY_REGRESSION])

    @property
    def energy_propeller_j(self) -> float:
        """Integral of `power_propeller_w`, J."""
        return float(self.flat[T_ENERGY_PROPELLER])
