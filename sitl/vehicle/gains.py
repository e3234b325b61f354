"""Computes controller gains from the physics of a vehicle profile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mavfi_cli.core.frames import Vector, dot
from sitl.vehicle import cascade
from sitl.vehicle.cascade import THRUST_RESERVE
from sitl.vehicle.physics import INFLOW_SLOPE
from sitl.vehicle.profile import GRAVITY_MPS2, LEVEL_SHARE, VehicleProfile

RATE_DAMPING = 0.75
RATE_BANDWIDTH_PER_LAG = 1.6  # natural frequency of the tilt-rate loop x motor time constant
CLIMB_SHARE = 0.6  # fraction of the spare thrust for climb acceleration
TILT_TO_RATE = 0.36  # tilt gain / natural frequency of the rate loop


def gains_for(profile: VehicleProfile, dt_s: float) -> Vector:
    """Return the gains of a vehicle's controller, as an array of shape (cascade.GAINS_SIZE,).

    `dt_s` is the controller's step.

    The rate loop is designed as a second-order system with the motor's lag tau: torque
    I (P e - D w') gives tau s^2 + (1 + D) s + P. The outer gains follow from its natural frequency.
    """
    gains = np.zeros(cascade.GAINS_SIZE)
    gains[cascade.G_DT] = dt_s
    gains[cascade.G_MASS] = profile.total_mass_kg
    gains[cascade.G_GRAVITY] = GRAVITY_MPS2
    gains[cascade.G_INERTIA : cascade.G_INERTIA + 3] = profile.inertia_kgm2
    _inner(gains, profile)
    _outer(gains, profile)
    _drag(gains, profile)
    _mixer(gains, profile)
    return gains


def _inner(gains: Vector, profile: VehicleProfile) -> None:
    hover_n = profile.total_mass_kg * GRAVITY_MPS2 / 4.0
    lag_s = profile.rotor.time_constant_s(hover_n)
    natural = RATE_BANDWIDTH_PER_LAG / lag_s
    p = lag_s * natural**2
    d = max(2.0 * RATE_DAMPING * natural * lag_s - 1.0, 0.0)
    yaw_p = 0.3 / lag_s
    gains[cascade.G_RATE_P : cascade.G_RATE_P + 3] = (p, p, yaw_p)
    gains[cascade.G_RATE_D : cascade.G_RATE_D + 3] = (d, d, 0.0)
    gains[cascade.G_RATE_I : cascade.G_RATE_I + 3] = (0.5 * p, 0.5 * p, 0.5 * yaw_p)
    gains[cascade.G_TILT_P] = TILT_TO_RATE * natural
    gains[cascade.G_TILT_RATE_LIMIT] = math.radians(profile.limits.tilt_rate_degps)
    gains[cascade.G_HEADING_P] = 0.4 * yaw_p
    gains[cascade.G_HEADING_MODEL_P] = 3.0
    gains[cascade.G_YAW_RATE_LIMIT] = math.radians(profile.limits.yaw_rate_degps)
    authority = 0.2 * hover_n * 4.0 * profile.rotor.torque_per_thrust_m
    gains[cascade.G_YAW_ACCELERATION] = min(authority / profile.inertia_kgm2[2], 4.0)


def _outer(gains: Vector, profile: VehicleProfile) -> None:
    limits = profile.limits
    tangent = math.tan(math.radians(limits.tilt_deg))
    tilt_lag_s = 1.0 / gains[cascade.G_TILT_P]
    lift_lag_s = profile.rotor.time_constant_s(profile.total_mass_kg * GRAVITY_MPS2 / 4.0)
    gains[cascade.G_POSITION_P : cascade.G_POSITION_P + 3] = (1.0, 1.0, 1.2)
    gains[cascade.G_MODEL_P : cascade.G_MODEL_P + 3] = (3.5, 3.5, 4.0)
    gains[cascade.G_MODEL_LAG : cascade.G_MODEL_LAG + 3] = (tilt_lag_s, tilt_lag_s, lift_lag_s)
    gains[cascade.G_VELOCITY_P : cascade.G_VELOCITY_P + 3] = (2.2, 2.2, 4.0)
    gains[cascade.G_VELOCITY_I : cascade.G_VELOCITY_I + 3] = (0.8, 0.8, 2.0)
    gains[cascade.G_INTEGRAL_LIMIT : cascade.G_INTEGRAL_LIMIT + 3] = (4.0, 4.0, 5.0)
    gains[cascade.G_ACCELERATION_LIMIT] = LEVEL_SHARE * GRAVITY_MPS2 * tangent
    spare_mps2 = THRUST_RESERVE * profile.max_thrust_n / profile.total_mass_kg - GRAVITY_MPS2
    gains[cascade.G_ACCELERATION_LIMIT + 1] = min(
        limits.vertical_acceleration_mps2, CLIMB_SHARE * spare_mps2
    )
    gains[cascade.G_SPEED_LIMIT] = limits.horizontal_speed_mps
    gains[cascade.G_CLIMB_LIMIT] = limits.climb_mps
    gains[cascade.G_DESCENT_LIMIT] = limits.descent_mps
    gains[cascade.G_TILT_TANGENT] = tangent


def _drag(gains: Vector, profile: VehicleProfile) -> None:
    """Set the gains for body drag and for the thrust loss of climbing rotors.

    The thrust loss is dT/dV = slope T / (J0 n D).
    """
    rotor, mass_kg = profile.rotor, profile.total_mass_kg
    hover_n = mass_kg * GRAVITY_MPS2 / 4.0
    speed_hz = math.sqrt(hover_n / rotor.max_thrust_n) * rotor.max_rpm / 60.0
    inflow = 4.0 * hover_n * INFLOW_SLOPE
    inflow /= rotor.zero_thrust_advance_ratio * speed_hz * rotor.diameter_m
    linear = np.array(profile.drag.linear_nspm) + np.array([0.0, 0.0, inflow])
    gains[cascade.G_DRAG_LINEAR : cascade.G_DRAG_LINEAR + 3] = linear / mass_kg
    quadratic = np.array(profile.drag.quadratic_ns2pm2)
    gains[cascade.G_DRAG_QUADRATIC : cascade.G_DRAG_QUADRATIC + 3] = quadratic / mass_kg


def _mixer(gains: Vector, profile: VehicleProfile) -> None:
    rotor = profile.rotor
    full_v = rotor.full_throttle_voltage_v
    torque_nm = rotor.max_thrust_n * rotor.torque_per_thrust_m
    gains[cascade.G_ROTOR_THRUST] = rotor.max_thrust_n
    gains[cascade.G_ROTOR_OFFSET] = rotor.arm_m / math.sqrt(2.0)
    gains[cascade.G_TORQUE_PER_THRUST] = rotor.torque_per_thrust_m
    gains[cascade.G_THROTTLE : cascade.G_THROTTLE + 3] = (
        rotor.motor_no_load_current_a * rotor.motor_resistance_ohm / full_v,
        rotor.max_rpm / rotor.motor_kv_rpmpv / full_v,
        torque_nm / rotor.torque_constant_nmpa * rotor.motor_resistance_ohm / full_v,
    )


_REDUCED = 0.6  # real firmware filters its gyroscope, and its outputs are a step late


@dataclass(frozen=True, slots=True, kw_only=True)
class RateLoops:
    """The gains of our rate loops, reduced for real firmware, and the data to convert them.

    A firmware's gain gives the torque as a share of its mixer's torque at full command.
    """

    p: Vector  # (3,) N m of torque per rad/s
    i: Vector  # (3,) N m per rad
    d: Vector  # (3,) N m per rad/s^2
    tilt_nm: float  # torque of all rotors at full differential thrust, about a level axis
    yaw_nm: float
    tilt_p: float  # 1/s
    hover_share: float  # thrust in hover / maximum thrust
    curve: float  # f in thrust share = f u^2 + (1 - f) u for a motor command u

    @classmethod
    def of(cls, profile: VehicleProfile) -> RateLoops:
        """Return the rate loops for the vehicle of a profile."""
        gains = gains_for(profile, 0.004)
        shares = np.linspace(0.05, 1.0, 40)
        commands = np.array([cascade.throttle(share, gains) for share in shares])
        bend = commands**2 - commands
        inertia = gains[cascade.G_INERTIA : cascade.G_INERTIA + 3]
        thrust_n = 4.0 * float(gains[cascade.G_ROTOR_THRUST])
        return cls(
            p=inertia * gains[cascade.G_RATE_P : cascade.G_RATE_P + 3] * _REDUCED,
            i=inertia * gains[cascade.G_RATE_I : cascade.G_RATE_I + 3] * _REDUCED,
            d=inertia * gains[cascade.G_RATE_D : cascade.G_RATE_D + 3] * _REDUCED,
            tilt_nm=thrust_n * float(gains[cascade.G_ROTOR_OFFSET]),
            yaw_nm=thrust_n * float(gains[cascade.G_TORQUE_PER_THRUST]),
            tilt_p=float(gains[cascade.G_TILT_P]) * _REDUCED,
            hover_share=profile.total_mass_kg * GRAVITY_MPS2 / thrust_n,
            curve=dot(bend, shares - commands) / dot(bend, bend),  # fitted by least squares
        )

    def parameters(
        self, pattern: str, axes: Sequence[str], shares: Sequence[float]
    ) -> dict[str, float]:
        """Return the firmware's P, I and D gains for roll, pitch and yaw, keyed by parameter name.

        Args:
            pattern: Pattern of the names, such as "MC_{axis}RATE_{term}".
            axes: Names of roll, pitch and yaw in the pattern.
            shares: For each axis, the fraction of `tilt_nm` or `yaw_nm` that full command produces.
        """
        full = (self.tilt_nm, self.tilt_nm, self.yaw_nm)
        return {
            pattern.format(axis=axis, term=term): gain[number] / (full[number] * shares[number])
            for number, axis in enumerate(axes)
            for term, gain in (("P", self.p), ("I", self.i), ("D", self.d))
        }
