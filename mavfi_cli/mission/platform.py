"""Compute platforms: how long each kernel takes in simulated time. TOML files, one a platform."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mavfi_cli.core.config import load_toml
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.core.seeds import Stream, generator

KERNELS = ("point_cloud", "octomap", "collision_check", "planner", "control")
_FOLDER = Path(__file__).parent / "platforms"


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelLatency:
    """Latency of one kernel: log-normal around its median."""

    latency_s: float  # median of one invocation
    spread: float = 0.0  # sigma of the natural logarithm of the latency
    source: str = ""

    def __post_init__(self) -> None:
        if self.latency_s < 0.0:
            raise ValueError(f"latency_s must not be negative, got {self.latency_s:g}")
        if not 0.0 <= self.spread <= 2.0:
            raise ValueError(f"spread must be within 0 and 2, got {self.spread:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatformProfile:
    """A companion computer as the flight feels it: latencies, cores, power, mass."""

    name: str
    cores: int
    kernels: dict[str, KernelLatency]
    description: str = ""
    power_w: float = 0.0
    mass_kg: float = 0.0
    sources: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.cores < 1:
            raise ValueError(f"cores must be at least 1, got {self.cores}")
        missing = [kernel for kernel in KERNELS if kernel not in self.kernels]
        if missing:
            raise ValueError(f"kernels without a latency: {', '.join(missing)}")
        unknown = [kernel for kernel in self.kernels if kernel not in KERNELS]
        if unknown:
            raise ValueError(f"unknown kernels: {', '.join(unknown)} (known: {', '.join(KERNELS)})")
        if self.power_w < 0.0 or self.mass_kg < 0.0:
            raise ValueError("power_w and mass_kg must not be negative")


def platform_names() -> list[str]:
    """The shipped platforms, in alphabetical order."""
    return sorted(path.stem for path in _FOLDER.glob("*.toml"))


def load_platform(name_or_path: str) -> PlatformProfile:
    """A shipped platform by name, or a user's own by the path of its TOML file.

    Raises:
        UnknownName: no shipped platform has this name, and it is not a path to a TOML file.
        ConfigError: the file cannot be used.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml":
        if not path.is_file():
            raise ConfigError("no such file", path=path)
        return load_toml(path, PlatformProfile)
    if name_or_path not in platform_names():
        raise UnknownName("platform", name_or_path, platform_names())
    return load_toml(_FOLDER / f"{name_or_path}.toml", PlatformProfile)


class LatencyModel:
    """Draws the latency of each invocation from a platform profile.

    Each kernel has its own random stream, so that one kernel being called more often never
    changes what another draws.
    """

    def __init__(self, profile: PlatformProfile, root_seed: int) -> None:
        self._profile = profile
        self._streams: dict[str, np.random.Generator] = {
            kernel: generator(root_seed, Stream.LATENCY, kernel) for kernel in KERNELS
        }

    def draw_s(self, kernel: str) -> float:
        """Latency of the next invocation of `kernel`, s."""
        latency = self._profile.kernels[kernel]
        if latency.spread == 0.0:
            return latency.latency_s
        return latency.latency_s * math.exp(
            latency.spread * float(self._streams[kernel].standard_normal())
        )
