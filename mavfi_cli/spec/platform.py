"""Compute platforms: the latency of each kernel in simulated time. One TOML file per platform.

A file either gives the latency of every kernel, or names a shipped platform as its `base` with a
factor `scale` for each kernel or for the whole file.

`measured:FACTOR` needs no file. Its latencies are the kernel times that the host measures in
flight, times the factor. Such a flight is not repeatable.
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from mavfi_cli.core.config import load_toml, shipped_names, shipped_path
from mavfi_cli.core.errors import ConfigError, UnknownName, nearest

MEASURED = "measured"
FACTORS = (0.01, 1000.0)  # minimum and maximum factor of a measured platform
KERNELS = ("point_cloud", "octomap", "collision_check", "planner", "control")
_LONGEST_S = 3600.0
LARGEST = 1.0e6  # maximum mass or power; a larger value has the wrong unit
HARDWARE = ("mass_kg", "power_w", "heatsink_kgpw")
_FOLDER = Path(__file__).parent / "platforms"


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelLatency:
    """Latency of one kernel, log-normally distributed round its median."""

    latency_s: float  # median latency of an invocation
    spread: float = 0.0  # standard deviation of the natural logarithm of the latency
    source: str = ""

    def __post_init__(self) -> None:
        _check_latency(self.latency_s, self.spread)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatformProfile:
    """A companion computer: latencies, cores, power and mass.

    Raises:
        ValueError: A number is out of range, or a kernel is missing or unknown.
    """

    name: str
    cores: int
    kernels: dict[str, KernelLatency]
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
        _check_kernels(self.kernels)
        check_hardware(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelEntry:
    """A kernel in a file: a latency, or a factor on the base's latency."""

    latency_s: float | None = None
    scale: float | None = None
    spread: float | None = None  # None: that of the base, or 0
    source: str = ""

    def __post_init__(self) -> None:
        if (self.latency_s is None) is (self.scale is None):
            raise ValueError("needs either latency_s or scale")
        if self.scale is not None and self.scale <= 0.0:
            raise ValueError(f"scale must be above zero, got {self.scale:g}")
        _check_latency(self.latency_s or 0.0, self.spread or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class _PlatformFile:
    """Contents of a platform's TOML file."""

    name: str
    cores: int
    kernels: dict[str, _KernelEntry] = field(default_factory=dict)
    base: str = ""  # a shipped platform
    scale: float = 1.0  # factor on the base's latencies of kernels without an entry
    description: str = ""
    carried: bool = True
    power_w: float = 0.0
    mass_kg: float = 0.0
    heatsink_kgpw: float = 0.0
    sources: dict[str, str] = field(default_factory=dict)  # key -> source of its value

    def __post_init__(self) -> None:
        _check_names(self.kernels)
        if self.scale <= 0.0:
            raise ValueError(f"scale must be above zero, got {self.scale:g}")
        if not self.base and self.scale != 1.0:
            raise ValueError("scale needs a base, the platform whose latencies are scaled")


def _check_latency(latency_s: float, spread: float) -> None:
    if latency_s < 0.0:
        raise ValueError(f"latency_s must not be negative, got {latency_s:g}")
    if latency_s > _LONGEST_S:
        raise ValueError(f"latency_s must be at most {_LONGEST_S:g}, got {latency_s:g}")
    if not 0.0 <= spread <= 2.0:
        raise ValueError(f"spread must be within 0 and 2, got {spread:g}")


def _check_names(kernels: Collection[str]) -> None:
    for kernel in kernels:
        if kernel not in KERNELS:
            match = nearest(kernel, KERNELS)
            hint = f"did you mean {match!r}? " if match else ""
            raise ValueError(f"kernels.{kernel}: no such kernel; {hint}Known: {', '.join(KERNELS)}")


def _check_kernels(kernels: Collection[str]) -> None:
    _check_names(kernels)
    missing = [f"kernels.{kernel}" for kernel in KERNELS if kernel not in kernels]
    if missing:
        raise ValueError(f"{', '.join(missing)}: missing, a kernel without a latency")


def check_hardware(board: object) -> None:
    """Reject a board with negative or implausibly large mass or power.

    Raises:
        ValueError: names the key and the value.
    """
    for key in HARDWARE:
        value = getattr(board, key)
        if value < 0.0:
            raise ValueError(f"{key}: must not be negative, is {value:g}")
        if value > LARGEST:
            raise ValueError(f"{key}: must be at most {LARGEST:g}, is {value:g}")


def platform_names() -> list[str]:
    """Return the shipped platforms in alphabetical order."""
    return shipped_names(_FOLDER)


def load_platform(name_or_path: str) -> PlatformProfile:
    """Load a shipped platform by name, a TOML file by path, or `measured:FACTOR`.

    Raises:
        UnknownName: No shipped platform has this name, and it is not a path to a TOML file.
        ConfigError: The file or the factor cannot be used.
    """
    factor = measured_factor(name_or_path)
    if factor is not None:
        return _measured(factor)
    if not name_or_path.endswith(".toml") and name_or_path not in platform_names():
        raise UnknownName("platform", name_or_path, [*platform_names(), f"{MEASURED}:FACTOR"])
    path = shipped_path("platform", name_or_path, _FOLDER)
    return _resolved(load_toml(path, _PlatformFile), path)


def measured_factor(name: str) -> float | None:
    """Return the factor of a platform `measured:FACTOR`; None for any other.

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
            f"the factor of {MEASURED}:FACTOR must be a number within {low:g} and {high:g}, "
            f"got {text!r}",
            key="platform",
        )
    return factor


def _measured(factor: float) -> PlatformProfile:
    source = f"this host's own times while it flies, x {factor:g}"
    return PlatformProfile(
        name=f"{MEASURED}:{factor:g}",
        cores=len(os.sched_getaffinity(0)),
        kernels=dict.fromkeys(KERNELS, KernelLatency(latency_s=0.0, source=source)),
        description=f"{source}; needs --realtime, and does not repeat",
        carried=False,
        measured_factor=factor,
    )


def _resolved(file: _PlatformFile, path: Path) -> PlatformProfile:
    """Build the profile of a file from its own latencies and those of its base."""
    base: dict[str, KernelLatency] = {}
    if file.base:
        if file.base not in platform_names() or path == _FOLDER / f"{file.base}.toml":
            error = UnknownName("platform", file.base, set(platform_names()) - {path.stem})
            raise ConfigError(str(error), path=path, key="base")
        base = load_platform(file.base).kernels
    named = {each.name for each in fields(_PlatformFile)}
    shared = {e.name: getattr(file, e.name) for e in fields(PlatformProfile) if e.name in named}
    try:
        return PlatformProfile(**{**shared, "kernels": _kernels(file, base, path)})
    except ValueError as error:
        raise ConfigError(str(error), path=path) from None


def _kernels(
    file: _PlatformFile, base: dict[str, KernelLatency], path: Path
) -> dict[str, KernelLatency]:
    """Return the latency of each kernel: its own entry, or the base's times the file's factor."""
    scale_source = _scaled(file.base, file.scale, file.sources.get("scale", ""))
    kernels = {
        name: replace(latency, latency_s=latency.latency_s * file.scale, source=scale_source)
        for name, latency in base.items()
    }
    for name, entry in file.kernels.items():
        if entry.scale is not None and not base:
            raise ConfigError("scale needs a base", path=path, key=f"kernels.{name}")
        kernels[name] = _latency(entry, base.get(name), file.base)
    return kernels


def _latency(entry: _KernelEntry, base: KernelLatency | None, base_name: str) -> KernelLatency:
    spread = entry.spread if entry.spread is not None else (base.spread if base else 0.0)
    if entry.scale is None or base is None:
        assert entry.latency_s is not None
        return KernelLatency(latency_s=entry.latency_s, spread=spread, source=entry.source)
    return KernelLatency(
        latency_s=entry.scale * base.latency_s,
        spread=spread,
        source=_scaled(base_name, entry.scale, entry.source),
    )


def _scaled(base_name: str, scale: float, source: str) -> str:
    """Describe the source of a latency that is a multiple of another platform's."""
    scaled = f"{base_name} x {scale:g}"
    return f"{scaled}: {source}" if source else scaled
