"""The F-1 model (Krishnan et al., IEEE CAL 19(1), 2020): its vehicles, boards and equations.

A vehicle that senses up to `range_m` and takes `response_s` from sensing to acting must fly slowly
enough to stop within that range. A board is the computer that it carries. A protection scheme costs
extra boards or compute time. Each vehicle and each board has its own TOML file. The names of
numbers end in their units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.config import Shipped, load_toml
from mavfi_cli.core.errors import CannotLift, ConfigError, UnknownName
from mavfi_cli.spec.platform import HARDWARE, LARGEST, PlatformProfile, check_hardware

CALIBRATED = ("rotor_pull_n", "response_s")  # the parameters that a calibration may set
SMALLEST = 1.0e-6  # in any unit; a smaller value is probably in the wrong unit
SMALL_KG = 0.67  # geometric mean of the simulated vehicles, 0.3 kg and 1.5 kg
VEHICLES = Shipped("vehicle", Path(__file__).parent / "vehicles")
BOARDS = Shipped("board", Path(__file__).parent / "boards")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Calibration:
    """An unpublished parameter of a vehicle, and the published ratio that determines it."""

    parameter: str  # one of CALIBRATED
    board: str  # the shipped board of the redundant computers
    tmr_time_ratio: float  # flight time with TMR over that with detection and recovery
    source: str  # source of the ratio

    def __post_init__(self) -> None:
        if self.parameter not in CALIBRATED:
            raise ValueError(f"parameter: must be {' or '.join(CALIBRATED)}, got {self.parameter}")
        if self.tmr_time_ratio <= 1.0:
            raise ValueError(f"tmr_time_ratio: must be above 1, got {self.tmr_time_ratio:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelVehicle:
    """A quadrotor as the model sees it.

    A parameter is None if its value comes from a calibration or from the platform.
    """

    name: str  # name of the vehicle
    mass_kg: float  # frame, rotors and battery, without the boards
    rotor_pull_n: float | None = None  # thrust of all rotors at full throttle
    response_s: float | None = None  # time from sensing to acting, if no platform is named
    range_m: float  # range of the sensor
    sensor_hz: float  # frame rate of the sensor
    hover_power_w: float  # power in hover at mass_kg
    battery_wh: float  # energy of the full battery
    tilt_deg: float = 0.0  # tilt of the rotors while braking
    board: str = ""  # a shipped board, if no platform is named
    flies_as: str = ""  # simulated vehicle that flies in its place; empty: one of similar mass
    description: str = ""  # for readers of the file
    sources: dict[str, str] = field(default_factory=dict)  # key -> source of its number
    calibration: _Calibration | None = None  # the number that a published ratio determines

    def __post_init__(self) -> None:
        for key in (
            "mass_kg", "rotor_pull_n", "response_s", "range_m", "sensor_hz", "hover_power_w",
            "battery_wh",
        ):  # fmt: skip
            value = getattr(self, key)
            if value is not None and value <= 0.0:
                raise ValueError(f"{key}: must be above 0, got {value:g}")
            if value is not None and not SMALLEST <= value <= LARGEST:
                least = value < SMALLEST
                limit = f"at least {SMALLEST:g}" if least else f"at most {LARGEST:g}"
                raise ValueError(f"{key}: must be {limit}, got {value:g}")
        if not 0.0 <= self.tilt_deg < 90.0:
            raise ValueError(f"tilt_deg: must be between 0 and 90, got {self.tilt_deg:g}")
        free = self.calibration.parameter if self.calibration else ""
        if free and getattr(self, free) is not None:
            raise ValueError(
                f"{free}: has a value, so it cannot be calibrated; remove it or [calibration]"
            )
        if self.rotor_pull_n is None and free != "rotor_pull_n":
            raise ValueError("rotor_pull_n: missing; give it, or calibrate it in [calibration]")
        if free == "rotor_pull_n" and self.response_s is None:
            raise ValueError("response_s: missing; the calibration of rotor_pull_n needs it")

    @classmethod
    def load(cls, name_or_path: str) -> ModelVehicle:
        """Load a shipped vehicle by its name, or a user's vehicle by the path of its TOML file.

        Raises:
            UnknownName: no shipped vehicle has this name, and it is not a path to a TOML file.
            ConfigError: the file cannot be read, or it contains an invalid value.
        """
        return load_toml(VEHICLES.path(name_or_path), cls)

    @property
    def stand_in(self) -> str:
        """Name of the simulated vehicle that flies missions in place of this one."""
        if self.flies_as:
            return self.flies_as
        return "spark" if self.mass_kg < SMALL_KG else "solo"

    @property
    def tilt_rad(self) -> float:
        """Angle between the thrust and the vertical while braking, in radians."""
        return math.radians(self.tilt_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A computer that a vehicle carries. Redundancy needs several copies of it."""

    name: str  # name of the board
    mass_kg: float  # mass without the heat sink
    power_w: float  # thermal design power
    heatsink_kgpw: float  # mass of the heat sink per watt of power_w
    description: str = ""  # for readers of the file
    sources: dict[str, str] = field(default_factory=dict)  # key -> source of its number

    def __post_init__(self) -> None:
        check_hardware(self)

    @property
    def total_kg(self) -> float:
        """Mass of one board with its heat sink, in kg."""
        return self.mass_kg + self.heatsink_kgpw * self.power_w

    @classmethod
    def load(cls, name_or_path: str) -> Board:
        """Load a shipped board by its name, or a user's board by the path of its TOML file.

        Raises the same errors as `ModelVehicle.load`.
        """
        return load_toml(BOARDS.path(name_or_path), cls)

    @classmethod
    def of_platform(cls, platform: PlatformProfile) -> Board:
        """Return the board of a platform. If it stays on the ground, its mass and power are 0."""
        name = f"platform {platform.name}"
        sources = {key: f"{name}: {platform.sources.get(key, 'not given')}" for key in HARDWARE}
        if not platform.carried:
            sources = dict.fromkeys(HARDWARE, f"{name} stays on the ground")
        return cls(
            name=platform.name,
            description=platform.description,
            sources=sources,
            **{key: getattr(platform, key) if platform.carried else 0.0 for key in HARDWARE},
        )


REFERENCE = "aad"  # scheme with which the paper's Fig. 15 compares redundancy


@dataclass(frozen=True, slots=True, kw_only=True)
class Scheme:
    """A scheme that protects the computer from faults, by redundant boards or by a detector.

    The scheme named `none` gives no protection.
    """

    name: str
    title: str
    copies: int = 1  # boards with their heat sinks
    overhead: float = 0.0  # additional compute time, as a fraction of that without protection
    source: str = ""


TABLE_V = "paper, Table V: Dense, the worst of four environments"
_SCHEMES = (
    Scheme(name="none", title="no protection", source="one board"),
    Scheme(name="dmr", title="DMR", copies=2, source="two boards; no time for the comparison"),
    Scheme(name="tmr", title="TMR", copies=3, source="three boards; no time for the vote"),
    Scheme(name="gad", title="detection (Gaussian)", overhead=0.022223, source=TABLE_V),
    Scheme(name="aad", title="detection (autoencoder)", overhead=0.000062, source=TABLE_V),
)

SCHEMES = {scheme.name: scheme for scheme in _SCHEMES}
DETECTORS = tuple(scheme.name for scheme in _SCHEMES if scheme.overhead > 0.0)


def schemes_with(overheads: Mapping[str, tuple[float, str]]) -> dict[str, Scheme]:
    """Return all protection schemes by name, with some of the paper's overheads replaced.

    Args:
        overheads: for each detector whose overhead is to be replaced, the new overhead in per cent
            of the compute time, and the source of this number.

    Raises:
        UnknownName: a name is not that of a scheme with detection and recovery.
        ConfigError: an overhead is negative, not finite, or so large that its unit must be wrong.
    """
    schemes = dict(SCHEMES)
    for name, (percent, source) in overheads.items():
        if name not in DETECTORS:
            raise UnknownName("detector", name, DETECTORS)
        if not 0.0 <= percent <= LARGEST:
            raise ConfigError(
                f"{name} must be between 0 and {LARGEST:g} %, got {percent:g} %", key="overhead"
            )
        schemes[name] = replace(schemes[name], overhead=percent / 100.0, source=source)
    return schemes


GRAVITY_MPS2 = 9.80665
KNEE_SHARE = 0.97  # share of the roof; CAL20 gives no closed form, its Fig. 4 shows 0.96 to 0.97

Number = TypeVar("Number", float, NDArray[np.float64])


def acceleration_mps2(pull_n: float, mass_kg: float, tilt_rad: float = 0.0) -> float:
    """Return the largest acceleration, in m/s^2: (T cos(tilt) - m g) / m (CAL20, equation 2).

    If the result is zero or less, the vehicle cannot lift its mass.

    Args:
        pull_n: thrust of all rotors at full throttle, N.
        mass_kg: mass of everything that flies, kg.
        tilt_rad: angle between the thrust and the vertical, rad; 0 reproduces the paper's Table 1.
    """
    return pull_n * math.cos(tilt_rad) / mass_kg - GRAVITY_MPS2


def safe_velocity_mps(accel_mps2: float, response_s: Number, range_m: float) -> Number:
    """Return the highest velocity, in m/s, from which the vehicle can stop within `range_m`.

    This is CAL20, equation 3, for response time T and range d: v = a (sqrt(T^2 + 2 d / a) - T), the
    root of d = v T + v^2 / (2 a). It is written here without the difference of two nearly equal
    numbers: v = 2 d / (T + sqrt(T^2 + 2 d / a)).

    Args:
        accel_mps2: acceleration, m/s^2, above zero.
        response_s: time from sensing to acting, s; a float or an array of any shape.
        range_m: range of the sensor, m.
    """
    root: Number = (response_s**2 + 2.0 * range_m / accel_mps2) ** 0.5
    return 2.0 * range_m / (response_s + root)


def roof_mps(accel_mps2: float, range_m: float) -> float:
    """Return the roof in m/s: the safe velocity if the response time were zero, sqrt(2 d a).

    Only the body dynamics limit it.
    """
    return math.sqrt(2.0 * range_m * accel_mps2)


def knee_hz(accel_mps2: float, range_m: float, share: float = KNEE_SHARE) -> float:
    """Return the action throughput, in Hz, at which the safe velocity is `share` times the roof.

    The roof is that of `roof_mps`. The result is CAL20, equation 3, solved for the throughput:
    f = sqrt(a / (2 d)) 2 share / (1 - share^2).
    """
    return math.sqrt(accel_mps2 / (2.0 * range_m)) * 2.0 * share / (1.0 - share**2)


def hover_power_w(known_w: float, known_kg: float, mass_kg: float) -> float:
    """Return the rotor power, in watts, for hovering with mass `mass_kg`.

    Momentum theory gives P ~ (m g)^1.5 / sqrt(2 rho A). The disc area and the figure of merit do
    not change with the mass, so one known pair of power and mass is enough.
    """
    return float(known_w * (mass_kg / known_kg) ** 1.5)


_J_PER_WH = 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Performance:
    """The performance of a vehicle with a protection scheme, on a straight path at hover power."""

    thrust_to_weight: float
    acceleration_mps2: float
    throughput_hz: float  # actions per second, the inverse of the response time
    compute_hz: float  # rate of the computer alone
    knee_hz: float  # throughput at KNEE_SHARE of the roof
    roof_mps: float
    sensor_ceiling_mps: float
    compute_ceiling_mps: float
    velocity_mps: float  # safe velocity
    flight_time_s: float
    power_w: float  # rotors and boards
    energy_j: float
    missions: float  # missions per battery charge, not rounded
    bound: str  # what limits the velocity


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelInputs:
    """The model's inputs for one vehicle and the computer that it carries."""

    vehicle: ModelVehicle
    board: Board
    pull_n: float
    range_m: float
    compute_s: float  # response time of the computer without protection
    distance_m: float

    def carried_kg(self, copies: int) -> float:
        """Return the mass of `copies` boards with their heat sinks, in kg."""
        return copies * self.board.total_kg

    def mass_kg(self, copies: int) -> float:
        """Return the total mass of the vehicle and `copies` boards with heat sinks, in kg."""
        return self.vehicle.mass_kg + self.carried_kg(copies)

    def acceleration_mps2(self, copies: int) -> float:
        """Return the largest acceleration with `copies` boards, in m/s^2.

        It is zero or less if the vehicle cannot lift the boards.
        """
        return acceleration_mps2(self.pull_n, self.mass_kg(copies), self.vehicle.tilt_rad)

    def response_s(self, overhead: float = 0.0) -> float:
        """Return the response time in seconds: the sensor's or computer's, whichever is longer.

        This is CAL20, equation 1.

        Args:
            overhead: additional compute time, as a fraction of that without protection.
        """
        return max(1.0 / self.vehicle.sensor_hz, self.compute_s * (1.0 + overhead))

    def velocity_mps(self, scheme: Scheme) -> float | None:
        """Return the safe velocity with a scheme, in m/s, or None if its boards are too heavy."""
        accel = self.acceleration_mps2(scheme.copies)
        if accel <= 0.0:
            return None
        return safe_velocity_mps(accel, self.response_s(scheme.overhead), self.range_m)

    def too_heavy(self, copies: int) -> CannotLift:
        """Return the error that explains why the vehicle cannot lift `copies` boards."""
        own_kg, compute_kg = self.vehicle.mass_kg, self.carried_kg(copies)
        limit_kg = self.mass_kg(copies) * (1.0 + self.acceleration_mps2(copies) / GRAVITY_MPS2)
        return CannotLift(
            f"vehicle {self.vehicle.name!r} cannot lift its compute: {self.pull_n:.2f} N of rotor "
            f"pull lift less than {limit_kg:.3f} kg, but {own_kg:.3f} kg + {compute_kg:.3f} kg of "
            f"compute weigh {own_kg + compute_kg:.3f} kg"
        )

    def performance(self, scheme: Scheme) -> Performance:
        """Return the vehicle's performance with a protection scheme.

        Raises:
            CannotLift: the rotors cannot lift the scheme's boards.
        """
        vehicle, copies = self.vehicle, scheme.copies
        accel, velocity = self.acceleration_mps2(copies), self.velocity_mps(scheme)
        if velocity is None:
            raise self.too_heavy(copies)
        mass_kg, compute_s = self.mass_kg(copies), self.compute_s * (1.0 + scheme.overhead)
        knee, response_s = knee_hz(accel, self.range_m), self.response_s(scheme.overhead)
        rotors_w = hover_power_w(vehicle.hover_power_w, vehicle.mass_kg, mass_kg)
        power_w = rotors_w + copies * self.board.power_w
        time_s = self.distance_m / velocity
        slower = "sensor" if 1.0 / vehicle.sensor_hz > compute_s else "compute"
        return Performance(
            thrust_to_weight=self.pull_n / (mass_kg * GRAVITY_MPS2),
            acceleration_mps2=accel,
            throughput_hz=1.0 / response_s,
            compute_hz=1.0 / compute_s,
            knee_hz=knee,
            roof_mps=roof_mps(accel, self.range_m),
            sensor_ceiling_mps=safe_velocity_mps(accel, 1.0 / vehicle.sensor_hz, self.range_m),
            compute_ceiling_mps=safe_velocity_mps(accel, compute_s, self.range_m),
            velocity_mps=velocity,
            flight_time_s=time_s,
            power_w=power_w,
            energy_j=power_w * time_s,
            missions=vehicle.battery_wh * _J_PER_WH / (power_w * time_s),
            bound="body dynamics" if 1.0 / response_s >= knee else slower,
        )
