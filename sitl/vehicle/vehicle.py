"""Simulates a quadrotor with its flight controller, energy and battery at a fixed rate."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.frames import Vector, ned_from_enu, ned_yaw_from_enu
from sitl.vehicle import cascade, physics
from sitl.vehicle.gains import gains_for
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

KMH_PER_MPS = 3.6

# Remaining charge at a lithium cell's empty, nominal, middle and full voltage.
_KNEES = np.array([0.0, 0.1, 0.5, 1.0])

PHYSICS_DT_S = 0.004


@compiled
def regression_power(velocity_mps: Vector, acceleration_mps2: Vector, b: Vector) -> float:
    """Return the rotor power, W, that a published regression gives for a vehicle's motion.

    The motion is a velocity (3,) and an acceleration (3,), and `b` has the coefficients (7,). The
    regression is that of Tseng et al., arXiv 1703.10049, with speeds in km/h and accelerations in
    km/h/s as in AirSim's fork. The result is never below zero.
    """
    v = KMH_PER_MPS * math.sqrt(velocity_mps[0] ** 2 + velocity_mps[1] ** 2)
    a = KMH_PER_MPS * math.sqrt(acceleration_mps2[0] ** 2 + acceleration_mps2[1] ** 2)
    vz = KMH_PER_MPS * abs(velocity_mps[2])
    az = KMH_PER_MPS * abs(acceleration_mps2[2])
    horizontal = b[0] * v + b[1] * a + b[2] * v * a
    vertical = b[3] * vz + b[4] * az + b[5] * vz * az
    power: float = horizontal + vertical + b[6]
    return max(power, 0.0)


@compiled
def open_circuit_voltage(remaining: float, parameters: Vector) -> float:
    """Return the voltage of the unloaded battery, V, at a remaining charge in 0..1."""
    for segment in range(3):
        if remaining <= _KNEES[segment + 1]:
            share: float = (remaining - _KNEES[segment]) / (_KNEES[segment + 1] - _KNEES[segment])
            low: float = parameters[segment]
            high: float = parameters[segment + 1]
            return low + share * (high - low)
    return float(parameters[3])


@compiled
def battery_current(power_w: float, open_circuit_v: float, resistance_ohm: float) -> float:
    """Return the current, A, at which the battery delivers `power_w`.

    It is the smaller root of P = I (V - I R), in a form without cancellation. If the battery cannot
    deliver that power, it is the current at the battery's maximum power.
    """
    if 4.0 * resistance_ohm * power_w > open_circuit_v * open_circuit_v:
        return open_circuit_v / (2.0 * resistance_ohm)
    root = math.sqrt(open_circuit_v * open_circuit_v - 4.0 * resistance_ohm * power_w)
    return 2.0 * power_w / (open_circuit_v + root)


@compiled
def _euler_quaternion(roll: float, pitch: float, yaw: float, out: Vector) -> None:
    """Write the quaternion of z-y-x Euler angles, in radians, to `out` (4,), with w >= 0."""
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
def _observe_motion(raw: Vector, dt_s: float, truth: Vector) -> None:
    """Update the values of motion and rotors in `truth` from JSBSim's raw state."""
    for axis in range(3):
        sign = -1.0 if axis == 2 else 1.0
        velocity = sign * raw[physics.RAW_VELOCITY + axis] * physics.FOOT_M
        if dt_s > 0.0:
            truth[T_ACCELERATION + axis] = (velocity - truth[T_VELOCITY + axis]) / dt_s
        truth[T_VELOCITY + axis] = velocity
        truth[T_POSITION + axis] = raw[physics.RAW_POSITION + axis] * physics.FOOT_M
        truth[T_RATES + axis] = raw[physics.RAW_RATES + axis]
    truth[T_POSITION + 2] = physics.PLANET_RADIUS_M - raw[physics.RAW_POSITION + 2] * physics.FOOT_M
    roll, pitch, yaw = raw[physics.RAW_EULER : physics.RAW_EULER + 3]
    _euler_quaternion(roll, pitch, yaw, truth[T_QUATERNION : T_QUATERNION + 4])
    truth[T_ON_GROUND] = 1.0 if raw[physics.RAW_WOW] > 0.0 else 0.0
    power_w = 0.0
    for rotor in range(4):
        truth[T_RPM + rotor] = raw[physics.RAW_RPM + rotor]
        power_w += raw[physics.RAW_POWER + rotor] * physics.FOOT_POUND_J
    truth[T_POWER_PROPELLER] = power_w


@compiled
def _account_energy(
    truth: Vector, regression: Vector, battery: Vector, dt_s: float, armed: bool
) -> None:
    """Update the values of power, energy and battery in `truth` after a step of `dt_s`."""
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
def _refresh(
    raw: Vector,
    commands: Vector,
    regression: Vector,
    battery: Vector,
    dt_s: float,
    armed: bool,
    truth: Vector,
) -> None:
    _observe_motion(raw, dt_s, truth)
    for rotor in range(4):
        truth[T_COMMANDS + rotor] = commands[rotor]
    _account_energy(truth, regression, battery, dt_s, armed)


@compiled
def _control(
    state: Vector, truth: Vector, setpoint: Vector, gains: Vector, armed: bool, commands: Vector
) -> None:
    """Run the flight controller, and update its state and the commands in place."""
    new, chosen = cascade.control_step(state, truth, setpoint, gains, armed)
    state[:] = new
    commands[:] = chosen


@compiled
def _refresh_and_control(
    raw: Vector,
    commands: Vector,
    regression: Vector,
    battery: Vector,
    dt_s: float,
    armed: bool,
    truth: Vector,
    stamp_s: float,
    state: Vector,
    setpoint: Vector,
    gains: Vector,
) -> None:
    """Update `truth` after a physics step, and run the controller for the next step."""
    truth[T_STAMP] = stamp_s
    _refresh(raw, commands, regression, battery, dt_s, armed, truth)
    _control(state, truth, setpoint, gains, armed, commands)


class Quadrotor:
    """Simulates one quadrotor with its flight controller, deterministically.

    The vehicle starts at rest at `position_enu_m` (3,). A position lower than
    `profile.rest_height_m`, the height of the centre of mass when the vehicle stands, is raised to
    that height. The yaw is counter-clockwise from east.
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
        self._physics = physics.Physics(
            profile,
            position_ned_m=ned_from_enu(start),
            heading_rad=ned_yaw_from_enu(yaw_enu_rad),
            dt_s=dt_s,
        )
        self._gains = gains_for(profile, dt_s)
        self._regression = profile.energy.coefficients(profile.extra_payload_kg)
        self._battery = profile.battery.parameters()
        self._state = np.zeros(cascade.STATE_SIZE)
        self._commands = np.zeros(4)
        self._raw = np.zeros(physics.RAW_SIZE)
        self._flat = np.zeros(TRUTH_SIZE)
        self._flat[T_REMAINING] = 1.0
        self._steps = 0
        self.truth = Truth(self._flat)
        self._refresh(np.zeros(4), 0.0, armed=False)

    def step(self, setpoint: Vector, armed: bool, count: int = 1) -> None:
        """Advance flight controller and physics by `count` steps. The motors stop unless `armed`.

        The setpoint (19,) is x y z, vx vy vz, ax ay az, yaw, yaw rate in NED; m, m/s, m/s^2, rad,
        rad/s; then a thrust in 0..1, an attitude w x y z from body FRD to NED, and body rates,
        rad/s. A component that is not finite is not controlled. With a thrust, only it and the
        attitude, or the rates, are controlled.
        """
        assert len(setpoint) == cascade.SETPOINT_SIZE  # compiled code does not check it
        commands, law = self._commands, (self._state, self._flat, setpoint, self._gains, armed)
        _control(*law, commands)
        for _ in range(count - 1):
            self._physics.advance(commands)
            self._physics.read(self._raw)
            self._steps += 1
            _refresh_and_control(
                self._raw, commands, self._regression, self._battery, self.dt_s, armed, self._flat,
                self._steps * self.dt_s, self._state, setpoint, self._gains,
            )  # fmt: skip
        self.drive(commands, armed=armed)

    def drive(self, commands: Vector, *, armed: bool) -> None:
        """Advance the physics by one step under motor commands (4,) in 0..1."""
        self._physics.advance(commands)
        self._steps += 1
        self._flat[T_STAMP] = self._steps * self.dt_s
        self._refresh(commands, self.dt_s, armed=armed)

    def _refresh(self, commands: Vector, dt_s: float, *, armed: bool) -> None:
        self._physics.read(self._raw)
        _refresh(self._raw, commands, self._regression, self._battery, dt_s, armed, self._flat)
