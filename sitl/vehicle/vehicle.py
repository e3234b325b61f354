"""A quadrotor with its flight controller, simulated at a fixed rate."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.frames import ned_from_enu, ned_yaw_from_enu
from sitl.control.cascade import control_step
from sitl.control.gains import gains_for
from sitl.control.layout import (
    M_ON_GROUND,
    M_POSITION,
    M_QUATERNION,
    M_RATES,
    M_VELOCITY,
    MEASUREMENT_SIZE,
    STATE_SIZE,
)
from sitl.vehicle.energy import (
    battery_current,
    battery_parameters,
    open_circuit_voltage,
    regression_coefficients,
    regression_power,
)
from sitl.vehicle.model import PLANET_RADIUS_M
from sitl.vehicle.physics import (
    FOOT_M,
    FOOT_POUND_J,
    RAW_EULER,
    RAW_POSITION,
    RAW_POWER,
    RAW_RATES,
    RAW_RPM,
    RAW_SIZE,
    RAW_VELOCITY,
    RAW_WOW,
    Physics,
)
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.truth import (
    T_ACCELERATION,
    T_COMMANDS,
    T_CURRENT,
    T_ENERGY_PROPELLER,
    T_ENERGY_REGRESSION,
    T_ON_GROUND,
    T_POSITION,
    T_POWER_PROPELLER,
    T_POWER_REGRESSION,
    T_QUATERNION,
    T_RATES,
    T_REMAINING,
    T_RPM,
    T_STAMP,
    T_VELOCITY,
    T_VOLTAGE,
    TRUTH_SIZE,
    Truth,
)

Vector = NDArray[np.float64]

PHYSICS_DT_S = 0.004


@compiled
def euler_quaternion(roll: float, pitch: float, yaw: float, out: Vector) -> None:
    """Write the quaternion (4,) of the z-y-x rotation yaw, pitch, roll, rad, with w >= 0."""
    cr, sr = math.cos(roll / 2.0), math.sin(roll / 2.0)
    cp, sp = math.cos(pitch / 2.0), math.sin(pitch / 2.0)
    cy, sy = math.cos(yaw / 2.0), math.sin(yaw / 2.0)
    w = cr * cp * cy + sr * sp * sy
    sign = 1.0 if w >= 0.0 else -1.0
    out[0] = sign * w
    out[1] = sign * (sr * cp * cy - cr * sp * sy)
    out[2] = sign * (cr * sp * cy + sr * cp * sy)
    out[3] = sign * (cr * cp * sy - sr * sp * cy)


@compiled
def observe_motion(raw: Vector, dt_s: float, truth: Vector) -> None:
    """Update motion and rotors in `truth` from JSBSim's raw state."""
    for axis in range(3):
        sign = -1.0 if axis == 2 else 1.0
        velocity = sign * raw[RAW_VELOCITY + axis] * FOOT_M
        if dt_s > 0.0:
            truth[T_ACCELERATION + axis] = (velocity - truth[T_VELOCITY + axis]) / dt_s
        truth[T_VELOCITY + axis] = velocity
        truth[T_POSITION + axis] = raw[RAW_POSITION + axis] * FOOT_M
        truth[T_RATES + axis] = raw[RAW_RATES + axis]
    truth[T_POSITION + 2] = PLANET_RADIUS_M - raw[RAW_POSITION + 2] * FOOT_M
    roll, pitch, yaw = raw[RAW_EULER : RAW_EULER + 3]
    euler_quaternion(roll, pitch, yaw, truth[T_QUATERNION : T_QUATERNION + 4])
    truth[T_ON_GROUND] = 1.0 if raw[RAW_WOW] > 0.0 else 0.0
    power_w = 0.0
    for rotor in range(4):
        truth[T_RPM + rotor] = raw[RAW_RPM + rotor]
        power_w += raw[RAW_POWER + rotor] * FOOT_POUND_J
    truth[T_POWER_PROPELLER] = power_w


@compiled
def account_energy(
    truth: Vector, regression: Vector, battery: Vector, dt_s: float, armed: bool
) -> None:
    """Update powers, energies and battery in `truth` after a step of `dt_s`."""
    power_w = 0.0
    if armed:
        velocity = truth[T_VELOCITY : T_VELOCITY + 3]
        acceleration = truth[T_ACCELERATION : T_ACCELERATION + 3]
        power_w = regression_power(velocity, acceleration, regression)
    truth[T_POWER_REGRESSION] = power_w
    truth[T_ENERGY_REGRESSION] += dt_s * power_w
    truth[T_ENERGY_PROPELLER] += dt_s * truth[T_POWER_PROPELLER]
    electrical_w = truth[T_POWER_PROPELLER] / battery[6] + battery[7]
    voltage = open_circuit_voltage(truth[T_REMAINING], battery)
    current = battery_current(electrical_w, voltage, battery[4])
    truth[T_CURRENT] = current
    truth[T_VOLTAGE] = voltage - current * battery[4]
    truth[T_REMAINING] = max(truth[T_REMAINING] - dt_s * current / battery[5], 0.0)


@compiled
def refresh(
    raw: Vector,
    commands: Vector,
    regression: Vector,
    battery: Vector,
    dt_s: float,
    armed: bool,
    truth: Vector,
    measurement: Vector,
) -> None:
    """Update `truth` and the controller's `measurement` in place after a step of `dt_s`."""
    observe_motion(raw, dt_s, truth)
    for rotor in range(4):
        truth[T_COMMANDS + rotor] = commands[rotor]
    account_energy(truth, regression, battery, dt_s, armed)
    measurement[M_POSITION : M_POSITION + 3] = truth[T_POSITION : T_POSITION + 3]
    measurement[M_VELOCITY : M_VELOCITY + 3] = truth[T_VELOCITY : T_VELOCITY + 3]
    measurement[M_QUATERNION : M_QUATERNION + 4] = truth[T_QUATERNION : T_QUATERNION + 4]
    measurement[M_RATES : M_RATES + 3] = truth[T_RATES : T_RATES + 3]
    measurement[M_ON_GROUND] = truth[T_ON_GROUND]


class Quadrotor:
    """Deterministic physics and flight controller of one quadrotor.

    Args:
        profile: Vehicle profile.
        position_enu_m: Initial position (3,) at rest. A position below the standing height is
            raised to it: the centre of mass is then `profile.rest_height_m` above the ground.
        yaw_enu_rad: Yaw, counter-clockwise from east.
        dt_s: Physics and control step, s.
    """

    def __init__(
        self,
        profile: VehicleProfile,
        *,
        position_enu_m: Sequence[float] | Vector,
        yaw_enu_rad: float,
        dt_s: float = PHYSICS_DT_S,
    ) -> None:
        self.profile = profile
        self.dt_s = dt_s
        start = np.array(position_enu_m, dtype=np.float64)
        start[2] = max(start[2], profile.rest_height_m)
        self._physics = Physics(
            profile,
            position_ned_m=ned_from_enu(start),
            heading_rad=ned_yaw_from_enu(yaw_enu_rad),
            dt_s=dt_s,
        )
        self._gains = gains_for(profile, dt_s)
        self._regression = regression_coefficients(profile.energy, profile.extra_payload_kg)
        self._battery = battery_parameters(profile.battery)
        self._state = np.zeros(STATE_SIZE)
        self._measurement = np.zeros(MEASUREMENT_SIZE)
        self._raw = np.zeros(RAW_SIZE)
        self._flat = np.zeros(TRUTH_SIZE)
        self._flat[T_REMAINING] = 1.0
        self._steps = 0
        self.truth = Truth(self._flat)
        self._refresh(np.zeros(4), 0.0, armed=False)

    def step(self, setpoint: Vector, armed: bool) -> None:
        """Advance physics and flight controller by one step.

        Args:
            setpoint: Setpoint (11,): x y z, vx vy vz, ax ay az, yaw, yaw rate in NED; m, m/s,
                m/s^2, rad, rad/s. Values that are not finite are not controlled.
            armed: False stops the motors.
        """
        self._state, commands = control_step(
            self._state, self._measurement, setpoint, self._gains, armed
        )
        self._physics.advance(commands)
        self._steps += 1
        self._flat[T_STAMP] = self._steps * self.dt_s
        self._refresh(commands, self.dt_s, armed=armed)

    def _refresh(self, commands: Vector, dt_s: float, *, armed: bool) -> None:
        self._physics.read(self._raw)
        refresh(
            self._raw,
            commands,
            self._regression,
            self._battery,
            dt_s,
            armed,
            self._flat,
            self._measurement,
        )
