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
    latencies of another. On a measured platform the latency is the host time of the kernel's newest
    invocation, times the profile's factor.
    """

    def __init__(
        self, profile: PlatformProfile, root_seed: int, wall: WallClock | None = None
    ) -> None:
        self._profile, self._wall = profile, wall
        self._streams = {kernel: generator(root_seed, Stream.LATENCY, kernel) for kernel in KERNELS}
        self._host_s: dict[str, list[float]] = {kernel: [] for kernel in KERNELS}

    def draw_s(self, kernel: str) -> float:
        """Return the latency of the next invocation of a kernel, or of its measured one, s."""
        if self._profile.measured_factor is not None:
            assert self._wall is not None
            host_s = self._wall.newest.get(kernel, 0.0)
            self._host_s[kernel].append(host_s)
            return self._profile.measured_factor * host_s
        latency = self._profile.kernels[kernel]
        if latency.spread == 0.0:
            return latency.latency_s
        return latency.latency_s * math.exp(
            latency.spread * float(self._streams[kernel].standard_normal())
        )

    def summary(self) -> dict[str, Any] | None:
        """Return the factor of a measured platform, and each kernel's medians, s; else None."""
        factor = self._profile.measured_factor
        if factor is None:
            return None
        medians = {kernel: float(np.median(s)) for kernel, s in self._host_s.items() if s}
        return {
            "platform": self._profile.name,
            "factor": factor,
            "kernels": {
                kernel: {
                    "host_median_s": median_s,
                    "latency_median_s": factor * median_s,
                    "invocations": len(self._host_s[kernel]),
                }
                for kernel, median_s in medians.items()
            },
        }
