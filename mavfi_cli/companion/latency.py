"""Latency of each kernel invocation in simulated time, drawn or measured."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.wall import WallClock
from mavfi_cli.spec.platform import KERNELS, PlatformProfile


class LatencyModel:
    """Draws the latency of each invocation from a platform profile.

    Each kernel has its own random stream, so the number of calls of one kernel never changes the
    latencies of another.
    """

    def __init__(self, profile: PlatformProfile, root_seed: int) -> None:
        self._profile = profile
        self._streams: dict[str, np.random.Generator] = {
            kernel: generator(root_seed, Stream.LATENCY, kernel) for kernel in KERNELS
        }

    def draw_s(self, kernel: str) -> float:
        """Return the latency of the next invocation of `kernel`, s."""
        latency = self._profile.kernels[kernel]
        if latency.spread == 0.0:
            return latency.latency_s
        return latency.latency_s * math.exp(
            latency.spread * float(self._streams[kernel].standard_normal())
        )

    def summary(self) -> dict[str, Any] | None:
        """Return None, because nothing was measured."""
        return None


class MeasuredLatency(LatencyModel):
    """Latencies from the host time of a kernel's newest invocation, times the profile's factor."""

    def __init__(self, profile: PlatformProfile, wall: WallClock) -> None:
        assert profile.measured_factor is not None
        self._name, self._factor, self._wall = profile.name, profile.measured_factor, wall
        self._host_s: dict[str, list[float]] = {kernel: [] for kernel in KERNELS}

    def draw_s(self, kernel: str) -> float:
        """Return the latency of the newest invocation of `kernel` on the host, s."""
        host_s = self._wall.newest.get(kernel, 0.0)
        self._host_s[kernel].append(host_s)
        return self._factor * host_s

    def summary(self) -> dict[str, Any]:
        """Return platform, factor, and each kernel's median on the host and in the flight, s."""
        medians = {kernel: float(np.median(s)) for kernel, s in self._host_s.items() if s}
        return {
            "platform": self._name,
            "factor": self._factor,
            "kernels": {
                kernel: {
                    "host_median_s": median_s,
                    "latency_median_s": self._factor * median_s,
                    "invocations": len(self._host_s[kernel]),
                }
                for kernel, median_s in medians.items()
            },
        }


def latency_model(profile: PlatformProfile, root_seed: int, wall: WallClock) -> LatencyModel:
    """Create the latency model of a platform.

    Args:
        profile: Platform.
        root_seed: Root seed of the mission.
        wall: Clock with the host times, for a measured platform.
    """
    if profile.measured_factor is not None:
        return MeasuredLatency(profile, wall)
    return LatencyModel(profile, root_seed)
