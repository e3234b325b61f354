"""Holds the vehicle's state at one instant in one array for physics, controller and referee."""

from __future__ import annotations

import math

from mavfi_cli.core.frames import Vector, rotate, rotation_matrix

T_STAMP = 0
T_POSITION = 1  # NED, m
T_VELOCITY = 4  # NED, m/s
T_ACCELERATION = 7
T_QUATERNION = 10  # w x y z, body FRD -> NED
T_RATES = 14  # body FRD, rad/s
T_COMMANDS = 17
T_RPM = 21
T_ON_GROUND = 25  # 0 or 1
T_VOLTAGE, T_CURRENT, T_REMAINING = 26, 27, 28
T_POWER_REGRESSION, T_POWER_PROPELLER = 29, 30
T_ENERGY_REGRESSION, T_ENERGY_PROPELLER = 31, 32
TRUTH_SIZE = 33


class _Scalar:
    """An attribute of `Truth` that reads one number from the array of the instance."""

    def __init__(self, index: int) -> None:
        self._index = index

    def __get__(self, truth: Truth, owner: type) -> float:
        return float(truth.flat[self._index])


class Truth:
    """Read-only view of the vehicle's true state.

    The arrays are views of the newest state, which changes in place, so copy values to keep them.

    The position is that of the centre of mass in the NED frame at the world origin on the ground.
    """

    stamp_s = _Scalar(T_STAMP)  # since the creation of the vehicle
    battery_voltage_v = _Scalar(T_VOLTAGE)  # at the terminals
    battery_current_a = _Scalar(T_CURRENT)
    battery_remaining = _Scalar(T_REMAINING)  # charge, 0..1
    power_regression_w = _Scalar(T_POWER_REGRESSION)  # published regression; 0 while disarmed
    power_propeller_w = _Scalar(T_POWER_PROPELLER)  # at the shafts of all rotors
    energy_regression_j = _Scalar(T_ENERGY_REGRESSION)
    energy_propeller_j = _Scalar(T_ENERGY_PROPELLER)

    def __init__(self, flat: Vector) -> None:
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
    def on_ground(self) -> bool:
        """True if a landing leg carries weight."""
        return bool(self.flat[T_ON_GROUND] > 0.5)

    @property
    def euler_rad(self) -> tuple[float, float, float]:
        """Roll, pitch, and yaw from north, in radians: the z-y-x Euler angles of the attitude."""
        w, x, y, z = self.quaternion_frd_ned.tolist()
        return (
            math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
            math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
        )

    def in_body(self, vector_ned: Vector) -> Vector:
        """Rotate a vector (3,) from NED to body FRD."""
        return rotate(rotation_matrix(self.quaternion_frd_ned).T, vector_ned)

    def wreck(self) -> Truth:
        """Return a copy of the state in which the vehicle lies still with its motors stopped."""
        flat = self.flat.copy()
        flat[T_VELOCITY:T_QUATERNION] = 0.0  # and acceleration
        flat[T_RATES:T_RPM] = 0.0  # and motor commands
        flat[[T_CURRENT, T_POWER_REGRESSION, T_POWER_PROPELLER]] = 0.0
        flat[T_ON_GROUND] = 1.0
        return Truth(flat)
