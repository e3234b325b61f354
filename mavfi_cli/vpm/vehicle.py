"""Vehicles and boards of the model, one TOML file each.

A vehicle has mass, rotor pull, sensor and battery. A board is the computer that it carries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from mavfi_cli.core.config import Shipped, load_toml
from mavfi_cli.spec.platform import HARDWARE, LARGEST, PlatformProfile, check_hardware

CALIBRATED = ("rotor_pull_n", "response_s")  # the parameters that a calibration may set
SMALLEST = 1.0e-6  # in any unit; a smaller value is probably in the wrong unit
SMALL_KG = 0.67  # geometric mean of the simulated vehicles, 0.3 kg and 1.5 kg
_VEHICLES = Shipped("vehicle", Path(__file__).parent / "vehicles")
_BOARDS = Shipped("board", Path(__file__).parent / "boards")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Calibration:
    """One unpublished number, set so that the model gives one published ratio."""

    parameter: str  # one of CALIBRATED
    board: str  # the shipped board of the redundant computers
    tmr_time_ratio: float  # flight time with TMR over that with detection and recovery
    source: str  # source of the ratio

    def __post_init__(self) -> None:
        if self.parameter not in CALIBRATED:
            raise ValueError(f"parameter: must be {' or '.join(CALIBRATED)}, is {self.parameter}")
        if self.tmr_time_ratio <= 1.0:
            raise ValueError(f"tmr_time_ratio: must be above 1, is {self.tmr_time_ratio:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelVehicle:
    """A quadrotor of the model; a number is None until it has been calibrated."""

    name: str  # of the vehicle
    mass_kg: float  # frame, rotors and battery, without the boards
    rotor_pull_n: float | None = None  # thrust of all rotors at full throttle
    response_s: float | None = None  # from sensing to acting, if no platform is named
    range_m: float  # range of the sensor
    sensor_hz: float  # frame rate of the sensor
    hover_power_w: float  # at mass_kg
    battery_wh: float  # energy of the full battery
    tilt_deg: float = 0.0  # tilt of the rotors while braking
    board: str = ""  # a shipped board, if no platform is named
    flies_as: str = ""  # the simulated vehicle that stands in for it; empty: one of its size
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
                raise ValueError(f"{key}: must be above zero, is {value:g}")
            if value is not None and not SMALLEST <= value <= LARGEST:
                least = value < SMALLEST
                limit = f"at least {SMALLEST:g}" if least else f"at most {LARGEST:g}"
                raise ValueError(f"{key}: must be {limit}, is {value:g}")
        if not 0.0 <= self.tilt_deg < 90.0:
            raise ValueError(f"tilt_deg: must be within 0 and 90, is {self.tilt_deg:g}")
        free = self.calibration.parameter if self.calibration else ""
        if free and getattr(self, free) is not None:
            raise ValueError(f"{free}: has a value, so it cannot be calibrated")
        if self.rotor_pull_n is None and free != "rotor_pull_n":
            raise ValueError("rotor_pull_n: is missing, and no calibration sets it")
        if free == "rotor_pull_n" and self.response_s is None:
            raise ValueError("response_s: is missing, the calibration needs it")

    @classmethod
    def load(cls, name_or_path: str) -> ModelVehicle:
        """A shipped vehicle of the model by name, or a user's own by the path of its TOML file.

        Raises:
            UnknownName: no shipped vehicle has this name, and it is not a path to a TOML file.
            ConfigError: the file cannot be used.
        """
        return load_toml(_VEHICLES.path(name_or_path), cls)

    @property
    def stand_in(self) -> str:
        """The simulated vehicle that flies in place of this one."""
        if self.flies_as:
            return self.flies_as
        return "spark" if self.mass_kg < SMALL_KG else "solo"

    @property
    def tilt_rad(self) -> float:
        """Angle between the thrust and the vertical, rad."""
        return math.radians(self.tilt_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """One copy of the computer that the vehicle carries."""

    name: str  # of the board
    mass_kg: float  # without the heat sink
    power_w: float  # thermal design power
    heatsink_kgpw: float  # mass of the heat sink for each watt of power_w
    description: str = ""  # for readers of the file
    sources: dict[str, str] = field(default_factory=dict)  # key -> source of its number

    def __post_init__(self) -> None:
        check_hardware(self)

    @property
    def total_kg(self) -> float:
        """Mass of a board and its heat sink, kg."""
        return self.mass_kg + self.heatsink_kgpw * self.power_w

    @classmethod
    def load(cls, name_or_path: str) -> Board:
        """A shipped board by name, or a user's own by path. Raises as `ModelVehicle.load`."""
        return load_toml(_BOARDS.path(name_or_path), cls)

    @classmethod
    def of_platform(cls, platform: PlatformProfile) -> Board:
        """The board of a platform; a platform on the ground has neither mass nor power."""
        told = f"platform {platform.name}"
        sources = {key: f"{told}: {platform.sources.get(key, 'not given')}" for key in HARDWARE}
        if not platform.carried:
            sources = dict.fromkeys(HARDWARE, f"{told} stays on the ground")
        return cls(
            name=platform.name,
            description=platform.description,
            sources=sources,
            **{key: getattr(platform, key) if platform.carried else 0.0 for key in HARDWARE},
        )
