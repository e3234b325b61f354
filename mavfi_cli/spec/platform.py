"""Compute platforms: the latency of each kernel in simulated time. One TOML file per platform.

A file either gives the latency of every kernel, or names a shipped platform as its `base` and
gives a factor, `scale`, for individual kernels or for all of them.

`measured:FACTOR` needs no file. Its latencies are the kernel times measured on the host in flight,
multiplied by the factor. Such a flight is not repeatable.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, fields
from pathlib import Path

from mavfi_cli.core.config import Shipped, load_toml
from mavfi_cli.core.errors import ConfigError, UnknownName, nearest
from mavfi_cli.core.types import KERNELS

MEASURED = "measured"
FACTORS = (0.01, 1000.0)  # minimum and maximum factor of a measured platform
_LONGEST_S = 3600.0
LARGEST = 1.0e6  # maximum mass or power; a larger value is probably in the wrong unit
HARDWARE = ("mass_kg", "power_w", "heatsink_kgpw")
PLATFORMS = Shipped("platform", Path(__file__).parent / "platforms")


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelLatency:
    """Latency of one kernel, log-normally distributed around its median."""

    latency_s: float  # median latency of an invocation
    spread: float = 0.0  # standard deviation of the natural logarithm of the latency
    source: str = ""

    def __post_init__(self) -> None:
        _check_latency(self.latency_s, self.spread)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatformProfile:
    """A companion computer: the latency of each kernel, and its cores, power and mass.

    Raises:
        ValueError: A number is out of range, or a kernel is missing or unknown.
    """

    name: str
    cores: int
    kernels: dict[str, _KernelLatency]
    description: str = ""
    carried: bool = True  # False: it stays on the ground and costs the vehicle no power or lift
    power_w: float = 0.0  # thermal design power
    mass_kg: float = 0.0  # board without its heat sink
    heatsink_kgpw: float = 0.0  # mass of the heat sink per watt of power_w
    sources: dict[str, str] = field(default_factory=dict)  # key -> source of its value
    base: str = ""  # platform whose latencies are scaled, if any
    measured_factor: float | None = None  # factor on the host's times, for a measured platform

    def __post_init__(self) -> None:
        if self.cores < 1:
            raise ValueError(f"cores must be at least 1, got {self.cores}")
        if missing := [f"kernels.{kernel}" for kernel in KERNELS if kernel not in self.kernels]:
            raise ValueError(f"{', '.join(missing)}: missing; every kernel must have a latency")
        check_hardware(self)

    @staticmethod
    def factor_of(name: str) -> float | None:
        """Return the factor of a platform named `measured:FACTOR`, or None for any other name.

        Raises:
            ConfigError: The factor is not a number or is out of range.
        """
        kind, colon, text = name.partition(":")
        if kind != MEASURED or not colon:
            return None
        low, high = FACTORS
        try:
            factor = float(text)
        except ValueError:
            factor = math.nan
        if not low <= factor <= high:
            raise ConfigError(
                f"the factor of {MEASURED}:FACTOR must be a number between {low:g} and {high:g}, "
                f"got {text!r}",
                key="platform",
            )
        return factor


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelEntry:
    """The entry for one kernel in a platform file: a latency, or a factor on the base's latency."""

    latency_s: float | None = None  # median latency of one invocation
    scale: float | None = None  # factor on the base's latency, instead of latency_s
    spread: float | None = None  # None: that of the base, or 0
    source: str = ""  # source of the number

    def __post_init__(self) -> None:
        if (self.latency_s is None) is (self.scale is None):
            raise ValueError("must have either latency_s or scale, but not both")
        _check_scale(self.scale)
        _check_latency(self.latency_s or 0.0, self.spread or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class _PlatformFile:
    """A platform's TOML file: the keys of `PlatformProfile`, with `_KernelEntry` for kernels."""

    name: str  # name of the platform
    cores: int  # number of nodes that compute at the same time
    kernels: dict[str, _KernelEntry] = field(default_factory=dict)  # kernel -> its entry
    base: str = ""  # a shipped platform
    scale: float = 1.0  # factor on the base's latencies of kernels without an entry
    description: str = ""  # text that `mavfi platforms` prints
    carried: bool = True  # false: it stays on the ground and costs the vehicle no mass or power
    power_w: float | None = None  # thermal design power
    mass_kg: float | None = None  # mass of the board without the heat sink
    heatsink_kgpw: float | None = None  # mass of the heat sink per watt
    sources: dict[str, str] = field(default_factory=dict)  # key -> source of its value

    def __post_init__(self) -> None:
        for kernel in self.kernels:
            if kernel not in KERNELS:
                match = nearest(kernel, KERNELS)
                hint = f"did you mean {match!r}? " if match else ""
                known = f"{hint}Known: {', '.join(KERNELS)}"
                raise ValueError(f"kernels.{kernel}: no such kernel; {known}")
        _check_scale(self.scale)
        if not self.base and self.scale != 1.0:
            raise ValueError("scale needs a base, the platform whose latencies are scaled")


def _check_latency(latency_s: float, spread: float) -> None:
    if latency_s < 0.0:
        raise ValueError(f"latency_s must be at least 0, got {latency_s:g}")
    if latency_s > _LONGEST_S:
        raise ValueError(f"latency_s must be at most {_LONGEST_S:g}, got {latency_s:g}")
    if not 0.0 <= spread <= 2.0:
        raise ValueError(f"spread must be between 0 and 2, got {spread:g}")


def _check_scale(scale: float | None) -> None:
    if scale is not None and scale <= 0.0:
        raise ValueError(f"scale must be above 0, got {scale:g}")


def check_hardware(board: object) -> None:
    """Reject a board with negative or implausibly large mass or power.

    Raises:
        ValueError: a value is out of range; the message names the key.
    """
    for key in HARDWARE:
        value = getattr(board, key)
        if value < 0.0:
            raise ValueError(f"{key}: must be at least 0, got {value:g}")
        if value > LARGEST:
            raise ValueError(f"{key}: must be at most {LARGEST:g}, got {value:g}")


def load_platform(name_or_path: str) -> PlatformProfile:
    """Load a shipped platform by name, a TOML file by path, or `measured:FACTOR`.

    Raises:
        UnknownName: No shipped platform has this name, and it is not a path to a TOML file.
        ConfigError: The file or the factor cannot be used.
    """
    if (factor := PlatformProfile.factor_of(name_or_path)) is not None:
        return _measured(factor)
    if not name_or_path.endswith(".toml") and name_or_path not in PLATFORMS.names:
        raise UnknownName("platform", name_or_path, [*PLATFORMS.names, f"{MEASURED}:FACTOR"])
    path = PLATFORMS.path(name_or_path)
    file = load_toml(path, _PlatformFile)
    base = load_platform(PLATFORMS.base(file.base, path)) if file.base else None
    values = {key.name: getattr(file, key.name) for key in fields(file) if key.name != "scale"}
    given = {key: value for key, value in values.items() if value is not None}
    own = () if path.parent == PLATFORMS.folder else ("cores", *HARDWARE)
    set_here = {key: f"set in {path.name}" for key in own if key in given}
    given["sources"] = {**set_here, **file.sources}
    given["kernels"] = _kernels(file, base, path)
    try:
        return PlatformProfile(**given)
    except ValueError as error:
        raise ConfigError(str(error), path=path) from None


def _measured(factor: float) -> PlatformProfile:
    source = f"kernel times measured on this host in flight, x {factor:g}"
    return PlatformProfile(
        name=f"{MEASURED}:{factor:g}",
        cores=len(os.sched_getaffinity(0)),
        kernels=dict.fromkeys(KERNELS, _KernelLatency(latency_s=0.0, source=source)),
        description=f"{source}; needs --realtime; flights do not repeat",
        carried=False,
        measured_factor=factor,
    )


def _kernels(
    file: _PlatformFile, base: PlatformProfile | None, path: Path
) -> dict[str, _KernelLatency]:
    """Return the latency of each kernel, keyed by the kernel's name.

    A kernel that has no entry in the file has the base's latency, multiplied by the file's `scale`.
    """
    based = {} if base is None else base.kernels
    scaled = _KernelEntry(scale=file.scale, source=file.sources.get("scale", ""))
    kernels = {}
    for name, entry in {**dict.fromkeys(based, scaled), **file.kernels}.items():
        latency_s, spread = entry.latency_s, entry.spread
        source = entry.source or f"set in {path.name}"
        if entry.scale is not None:
            if base is None:
                raise ConfigError(
                    "scale needs a base, the platform whose latency it multiplies",
                    path=path,
                    key=f"kernels.{name}",
                )
            latency_s = entry.scale * based[name].latency_s
            why = f": {entry.source}" if entry.source else ""
            source = f"{file.base} x {entry.scale:g}{why}"
        if spread is None:
            spread = based[name].spread if name in based else 0.0
        assert latency_s is not None
        try:
            kernels[name] = _KernelLatency(latency_s=latency_s, spread=spread, source=source)
        except ValueError as error:
            raise ConfigError(str(error), path=path) from None
    return kernels
