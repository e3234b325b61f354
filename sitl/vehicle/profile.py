"""Vehicle profiles. One TOML file describes one quadrotor, or scales a shipped one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.config import Shipped, read_toml, structure
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.frames import Vector

AIR_DENSITY_KGPM3 = 1.225  # ISA at sea level
GRAVITY_MPS2 = 9.80665
MIN_THRUST_TO_WEIGHT = 1.15  # reserve for control and climb

LARGEST_TILT_DEG = 60.0
LEVEL_SHARE = 0.9  # controller's fraction of the acceleration that the tilt limit allows

Triple = tuple[float, float, float]

# The middle voltage of a lithium cell lies 30 % of the way from nominal to full: 3.85 V for an
# ordinary 4.2 V cell.
_MIDDLE = 0.3

_LARGEST = 1e12  # largest magnitude of any value, in its unit
_ANY_SIGN = ("camera_mount_flu_m", "rotor.height_m", "energy.")
_MAY_BE_ZERO = (
    "extra_payload_kg", "drag.linear_nspm", "drag.quadratic_ns2pm2", "gear.friction",
    "rotor.motor_no_load_current_a", "battery.resistance_ohm", "battery.avionics_w",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rotor:
    """Four equal rotors on the diagonals of an X frame, with their motors."""

    arm_m: float  # from the centre to each rotor axis
    height_m: float  # rotor plane above the centre of mass
    diameter_m: float
    thrust_coefficient: float  # static C_T, T = C_T rho n^2 D^4, n in rev/s
    power_coefficient: float  # static C_P, P = C_P rho n^3 D^5
    zero_thrust_advance_ratio: float  # J = V / (n D) at which thrust vanishes
    max_rpm: float  # static, at full throttle
    inertia_kgm2: float  # propeller and bell about the axis
    motor_kv_rpmpv: float
    motor_resistance_ohm: float
    motor_no_load_current_a: float

    @property
    def max_thrust_n(self) -> float:
        """Static thrust of one rotor at `max_rpm`, N."""
        speed_hz = self.max_rpm / 60.0
        return self.thrust_coefficient * AIR_DENSITY_KGPM3 * speed_hz**2 * self.diameter_m**4

    @property
    def torque_per_thrust_m(self) -> float:
        """Drag torque of a rotor per newton of thrust, m: C_P D / (2 pi C_T)."""
        return self.power_coefficient * self.diameter_m / (2.0 * math.pi * self.thrust_coefficient)

    @property
    def torque_constant_nmpa(self) -> float:
        """Motor torque per ampere, N m/A: 60 / (2 pi Kv)."""
        return 60.0 / (2.0 * math.pi * self.motor_kv_rpmpv)

    def hover_power_w(self, mass_kg: float) -> float:
        """Return the shaft power of all four rotors in hover, W, from static C_T and C_P."""
        thrust_n = mass_kg * GRAVITY_MPS2 / 4.0
        speed_hz = math.sqrt(thrust_n / self.max_thrust_n) * self.max_rpm / 60.0
        power = self.power_coefficient * AIR_DENSITY_KGPM3 * speed_hz**3 * self.diameter_m**5
        return 4.0 * power

    @property
    def full_throttle_voltage_v(self) -> float:
        """Motor voltage at full throttle, V, at which the static propeller turns at `max_rpm`."""
        torque_nm = self.max_thrust_n * self.torque_per_thrust_m
        current_a = torque_nm / self.torque_constant_nmpa + self.motor_no_load_current_a
        return self.max_rpm / self.motor_kv_rpmpv + current_a * self.motor_resistance_ohm

    def time_constant_s(self, thrust_n: float) -> float:
        """Return the time constant, in seconds, with which a rotor's speed follows its voltage.

        The equation J dw/dt = Kt (V - w Kt) / R - Q(w), with Q proportional to w^2, is linearised
        at the rotor's thrust `thrust_n`.
        """
        share = math.sqrt(thrust_n / self.max_thrust_n)
        speed_radps = share * self.max_rpm * math.pi / 30.0
        load = 2.0 * thrust_n * self.torque_per_thrust_m / speed_radps
        return self.inertia_kgm2 / (self.torque_constant_nmpa**2 / self.motor_resistance_ohm + load)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Drag:
    """Body drag along each body axis: F = -(linear v + quadratic v |v|)."""

    linear_nspm: Triple  # forward, right, down; N s/m
    quadratic_ns2pm2: Triple  # N s^2/m^2


@dataclass(frozen=True, slots=True, kw_only=True)
class _Gear:
    """Four landing legs on the diagonals of the frame, with springs and dampers."""

    leg_radius_m: float  # from the centre, horizontally
    height_m: float  # centre of mass above the unloaded feet
    natural_frequency_radps: float = 40.0  # vehicle on its springs
    damping_ratio: float = 0.6
    friction: float = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class _Battery:
    """A lithium battery pack, and the drive train from it to the rotors' shafts."""

    cells: int
    capacity_ah: float
    cell_full_v: float = 4.2
    cell_nominal_v: float = 3.7
    cell_empty_v: float = 3.3
    resistance_ohm: float  # resistance of the whole pack
    drive_efficiency: float  # motor and speed controller, shaft power / electrical power
    avionics_w: float

    def parameters(self) -> Vector:
        """Return the numbers that the battery model needs, as an array of shape (8,).

        They are the open-circuit voltages of the empty, nominal, middle and full pack (V), its
        resistance (ohm), its capacity (C), the drive efficiency and the avionics' power (W).
        """
        middle = self.cell_nominal_v + _MIDDLE * (self.cell_full_v - self.cell_nominal_v)
        cells = (self.cell_empty_v, self.cell_nominal_v, middle, self.cell_full_v)
        volts = [self.cells * voltage for voltage in cells]
        capacity_c = self.capacity_ah * 3600.0
        return np.array(
            [*volts, self.resistance_ohm, capacity_c, self.drive_efficiency, self.avionics_w]
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _ControlLimits:
    tilt_deg: float = 35.0
    horizontal_speed_mps: float = 12.0
    climb_mps: float = 3.0
    descent_mps: float = 1.5
    vertical_acceleration_mps2: float = 4.0
    yaw_rate_degps: float = 90.0
    tilt_rate_degps: float = 220.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _EnergyRegression:
    """Coefficients of the published multiple regression of rotor power, with speeds in km/h.

    P = b1 v + b2 a + b3 v a + b4 vz + b5 az + b6 vz az + b7 m + b9, with horizontal v, a and
    vertical vz, az as magnitudes in km/h and km/h/s, and m the payload in grams
    (Tseng et al., arXiv 1703.10049). The wind term b8 is zero, because there is no wind.
    """

    b1: float
    b2: float
    b3: float
    b4: float
    b5: float
    b6: float
    b7: float
    b9: float

    def coefficients(self, payload_kg: float) -> Vector:
        """Return b1 to b6 and the constant term for a payload, as an array of shape (7,)."""
        constant = self.b9 + self.b7 * payload_kg * 1000.0
        return np.array([self.b1, self.b2, self.b3, self.b4, self.b5, self.b6, constant])


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleProfile:
    """The physical description of a quadrotor, with the limits of its controller.

    The body axes are x forward, y right, z down (FRD) unless a name says otherwise.
    """

    name: str
    description: str = ""
    mass_kg: float  # ready to fly, without payload
    extra_payload_kg: float = 0.0  # carried at the centre of mass
    inertia_kgm2: Triple  # Ixx, Iyy, Izz
    body_box_m: Triple  # length, width, height round the centre of mass, propellers included
    camera_mount_flu_m: Triple  # forward, left, up of the centre of mass
    rotor: _Rotor
    drag: _Drag
    gear: _Gear
    battery: _Battery
    limits: _ControlLimits
    energy: _EnergyRegression

    def __post_init__(self) -> None:
        for key, value in _numbers(self):
            _check_number(key, value)
        weight_n = self.total_mass_kg * GRAVITY_MPS2
        ratio = self.max_thrust_n / weight_n
        if not ratio >= MIN_THRUST_TO_WEIGHT:
            raise ConfigError(
                f"vehicle {self.name!r} cannot fly: {self.max_thrust_n:.1f} N of thrust for "
                f"{self.mass_kg:g} kg + {self.extra_payload_kg:g} kg payload ({weight_n:.1f} N). "
                f"The thrust-to-weight ratio must be at least {MIN_THRUST_TO_WEIGHT:g}, "
                f"got {ratio:.2f}"
            )
        for key, value, most in (
            ("limits.tilt_deg", self.limits.tilt_deg, LARGEST_TILT_DEG),
            ("battery.drive_efficiency", self.battery.drive_efficiency, 1.0),
        ):
            if value > most:
                raise ConfigError(f"must be at most {most:g}, got {value:g}", key=key)
        nominal_v = self.battery.cells * self.battery.cell_nominal_v
        if self.rotor.full_throttle_voltage_v > nominal_v:
            raise ConfigError(
                f"the voltage at rotor.max_rpm must be at most the battery's {nominal_v:.1f} V, "
                f"got {self.rotor.full_throttle_voltage_v:.1f} V"
            )

    @property
    def total_mass_kg(self) -> float:
        """Take-off mass, kg."""
        return self.mass_kg + self.extra_payload_kg

    @property
    def max_thrust_n(self) -> float:
        """Static thrust of all four rotors, N."""
        return 4.0 * self.rotor.max_thrust_n

    @property
    def physics(self) -> dict[str, float]:
        """Take-off mass, static thrust of all rotors and hover shaft power, for flight records."""
        return {
            "mass_kg": self.total_mass_kg,
            "rotor_pull_n": self.max_thrust_n,
            "hover_shaft_w": self.rotor.hover_power_w(self.total_mass_kg),
        }

    @property
    def gear_stiffness_npm(self) -> float:
        """Spring rate of one leg, N/m."""
        return self.total_mass_kg / 4.0 * self.gear.natural_frequency_radps**2

    @property
    def rest_height_m(self) -> float:
        """Height of the centre of mass above the ground when the vehicle stands on its legs, m."""
        sag_m = GRAVITY_MPS2 / self.gear.natural_frequency_radps**2
        return self.gear.height_m - sag_m


def _numbers(record: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield the dotted key and the value of every number in a nested dataclass."""
    for field in dataclasses.fields(record):
        value, key = getattr(record, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{key}.")
        elif isinstance(value, tuple):
            yield from ((key, item) for item in value)
        elif not isinstance(value, str):
            yield key, value


def _check_number(key: str, value: float) -> None:
    if value and not 1.0 / _LARGEST <= abs(value) <= _LARGEST:  # or sums and quotients overflow
        limits = f"{1.0 / _LARGEST:g} and {_LARGEST:g} in size"
        raise ConfigError(f"must be between {limits}, got {value:g}", key=key)
    may_be_zero = key in _MAY_BE_ZERO
    if not key.startswith(_ANY_SIGN) and (value < 0.0 or (value == 0.0 and not may_be_zero)):
        limit = "must be at least 0" if may_be_zero else "must be above 0"
        raise ConfigError(f"{limit}, got {value:g}", key=key)


@dataclass(frozen=True, slots=True, kw_only=True)
class _StandIn:
    """A profile with a `base`: a shipped quadrotor scaled to stand in for another vehicle.

    Mass, rotor pull, hover power and battery become those of the other vehicle. Size, propellers
    and drag stay those of the base. None keeps the value of the base.
    """

    name: str  # of the vehicle
    base: str  # name of a shipped profile
    description: str = ""  # for readers of the file
    mass_kg: float | None = None  # ready to fly, without payload
    extra_payload_kg: float = 0.0  # mass of a payload at the vehicle's centre
    rotor_pull_n: float | None = None  # static thrust of all rotors at full throttle
    acceleration_mps2: float | None = None  # horizontal acceleration that the tilt limit must allow
    hover_power_w: float | None = None  # electrical power of the rotors in hover at mass_kg
    battery_wh: float | None = None  # energy of the full battery
    avionics_w: float | None = None  # power of everything except the rotors

    def __post_init__(self) -> None:
        for key in ("mass_kg", "rotor_pull_n", "hover_power_w", "battery_wh", "acceleration_mps2"):
            value = getattr(self, key)
            if value is not None and value <= 0.0:
                raise ValueError(f"{key}: must be above 0, got {value:g}")

    def profile(self, base: VehicleProfile) -> VehicleProfile:
        """Return the base quadrotor, scaled to the other vehicle.

        - Inertia grows with mass_kg, because the shape stays the same. Payload adds none, because
          it is at the centre of mass.
        - The rotors turn faster for more pull. Thrust ~ n^2, so n grows with the square root of the
          ratio. The motors' Kv grows with n, so that the voltage at full throttle stays within the
          battery's.
        - The drive's efficiency is set so that the base's propellers take hover_power_w.
        - The tilt limit is raised if acceleration_mps2 needs it, to LARGEST_TILT_DEG at most.

        Raises:
            ConfigError: The profile cannot fly. The message gives the numbers.
            ValueError: The propellers take more shaft power than hover_power_w.
        """
        mass_kg = self.mass_kg or base.mass_kg
        faster = math.sqrt((self.rotor_pull_n or base.max_thrust_n) / base.max_thrust_n)
        rotor, battery = base.rotor, base.battery
        rotor = dataclasses.replace(
            rotor, max_rpm=faster * rotor.max_rpm, motor_kv_rpmpv=faster * rotor.motor_kv_rpmpv
        )
        if self.battery_wh is not None:
            nominal_v = battery.cells * battery.cell_nominal_v
            battery = dataclasses.replace(battery, capacity_ah=self.battery_wh / nominal_v)
        if self.avionics_w is not None:
            battery = dataclasses.replace(battery, avionics_w=self.avionics_w)
        if self.hover_power_w is not None:
            shaft_w = rotor.hover_power_w(mass_kg)
            share = shaft_w / self.hover_power_w
            if share > 1.0:
                raise ValueError(
                    f"hover_power_w: must be at least the {shaft_w:.1f} W that the propellers of "
                    f"{self.base!r} need to hover with {mass_kg:g} kg, got {self.hover_power_w:g}"
                )
            battery = dataclasses.replace(battery, drive_efficiency=share)
        grown = mass_kg / base.mass_kg
        ixx, iyy, izz = base.inertia_kgm2
        return dataclasses.replace(
            base,
            name=self.name,
            description=self.description,
            mass_kg=mass_kg,
            extra_payload_kg=self.extra_payload_kg,
            inertia_kgm2=(grown * ixx, grown * iyy, grown * izz),
            rotor=rotor,
            battery=battery,
            limits=dataclasses.replace(base.limits, tilt_deg=self._tilt_deg(base)),
        )

    def _tilt_deg(self, base: VehicleProfile) -> float:
        if self.acceleration_mps2 is None:
            return base.limits.tilt_deg
        tangent = self.acceleration_mps2 / (LEVEL_SHARE * GRAVITY_MPS2)
        needed_deg = math.degrees(math.atan(tangent))
        return min(max(needed_deg, base.limits.tilt_deg), LARGEST_TILT_DEG)


PROFILES = Shipped("vehicle", Path(__file__).parent / "profiles")


def load_profile(name_or_path: str) -> VehicleProfile:
    """Load a shipped profile by name, or any profile by the path of its TOML file.

    A file with a `base` scales a shipped profile. Raises UnknownName for any other name, and
    ConfigError if the file cannot be read or its vehicle cannot fly.
    """
    path = PROFILES.path(name_or_path)
    data, text = read_toml(path)
    if "base" not in data:
        return structure(data, VehicleProfile, path=path, text=text)
    stand_in = structure(data, _StandIn, path=path, text=text)
    base = PROFILES.base(stand_in.base, path)
    try:
        return stand_in.profile(load_profile(base))
    except (ConfigError, ValueError) as problem:
        raise ConfigError(str(problem), path=path) from None
