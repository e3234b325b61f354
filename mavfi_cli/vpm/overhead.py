"""The compute overhead of detection and recovery, from the records of flights.

As the paper's Table V: the time of all detection and recomputation of a mission, over the time that
the pipeline computes without them. Kernels take as long as on the flight's platform, recomputations
too; the checks take as long as they took on the host.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.mission.platform import load_platform
from mavfi_cli.mission.record.detection_cost import HOST_CHECKS, KERNELS, detection_cost

MEASURED = "measured"  # how the source of a measured overhead begins
TIMES = " x "  # between a platform's name and the one factor on its latencies, in a file's name
NEAR = 0.1  # a factor of the flights' latencies that far from 1 is still the platform
UNKNOWN = "an unknown platform"


@dataclass(frozen=True, slots=True, kw_only=True)
class Overhead:
    """What a detector cost in a number of flights.

    Attributes:
        detection_s: all checks of the gate, host time.
        recompute_s: recomputations, each at the mean latency of its stage's kernels, simulated.
        compute_s: all kernels, recomputations included, simulated.
        host_compute_s: all kernels, host time.
        alarms: after which something was computed again.
        platforms: names of those on which the flights flew, in alphabetical order.
        left_out: flights on other platforms, which do not count.
    """

    detector: str
    flights: int
    detection_s: float
    recompute_s: float
    compute_s: float
    host_compute_s: float
    alarms: int
    platforms: tuple[str, ...]
    left_out: int = 0

    @property
    def share(self) -> float:
        """Of the compute time without detection and recovery; 0.01 is one per cent."""
        return (self.detection_s + self.recompute_s) / (self.compute_s - self.recompute_s)

    @property
    def checks_share(self) -> float:
        """The part of `share` that the checks take; the rest is recomputation."""
        return self.detection_s / (self.compute_s - self.recompute_s)

    @property
    def checks_host_share(self) -> float:
        """The checks over the host's own kernel time, whose workload is far below the paper's."""
        return self.detection_s / self.host_compute_s

    def told(self, where: str) -> str:
        """Where the number comes from, for the table."""
        again = self.share - self.checks_share
        left = f" ({self.left_out} on other platforms left out)" if self.left_out else ""
        return (
            f"{MEASURED} in {self.flights} {'flight' if self.flights == 1 else 'flights'} of "
            f"{where} on {' and '.join(self.platforms)}{left}: checks "
            f"{100.0 * self.checks_share:.4g} %, {self.alarms} "
            f"{'recomputation' if self.alarms == 1 else 'recomputations'} {100.0 * again:.4g} %; "
            f"{HOST_CHECKS}"
        )


def overheads_of(
    results: Iterable[Mapping[str, Any]], platform: str | None = None
) -> dict[str, Overhead]:
    """The overhead of every detector in these records, over all of its flights together.

    Flights with a fault do not count: their alarms are the fault's.

    Args:
        results: result.json of flights.
        platform: only flights on this one count; None: all.
    """
    found: dict[str, Overhead] = {}
    left_out: dict[str, int] = {}
    names: dict[str, str] = {}  # of platforms, by what missions call them
    for result in results:
        called = str(result.get("config", {}).get("platform", UNKNOWN))
        if called not in names:
            names[called] = _platform_name(called)
        flown = _of_flight(result, names[called])
        if flown is None:
            continue
        if platform is not None and not _same(names[called], platform):
            left_out[flown.detector] = left_out.get(flown.detector, 0) + 1
            continue
        known = found.get(flown.detector)
        found[flown.detector] = flown if known is None else _sum(known, flown)
    return {name: replace(each, left_out=left_out.get(name, 0)) for name, each in found.items()}


def _platform_name(called: str) -> str:
    """The name in a platform's file where that is still there; without it, what it was called."""
    if not called.endswith(".toml"):
        return called
    try:
        return load_platform(called).name
    except MavfiError:
        return Path(called).stem


def _same(name: str, platform: str) -> bool:
    """Whether it is this platform, or what `mavfi vpm --fly` makes of it for a detector's share."""
    base, times, factor = name.rpartition(TIMES)
    if name == platform or not times or base != platform:
        return name == platform
    try:
        return abs(float(factor) - 1.0) <= NEAR
    except ValueError:  # a name of the user's own
        return False


def _of_flight(result: Mapping[str, Any], platform: str) -> Overhead | None:
    cost = None if result.get("fault") else detection_cost(result)
    if cost is None:
        return None
    walls, kernels = result["host"]["stage_wall_s"], result.get("kernels") or {}
    compute_s = math.fsum(kernels[name]["busy_s"] for name in KERNELS if name in kernels)
    host_compute_s = math.fsum(walls.get(name, 0.0) for name in KERNELS)
    if compute_s <= cost.recovered_s or host_compute_s <= 0.0:
        return None
    return Overhead(
        detector=cost.detector,
        flights=1,
        detection_s=cost.checks_host_s,
        recompute_s=cost.recovered_s,
        compute_s=compute_s,
        host_compute_s=host_compute_s,
        alarms=round(math.fsum(cost.recomputations.values())),
        platforms=(platform,),
    )


def _sum(first: Overhead, second: Overhead) -> Overhead:
    return Overhead(
        detector=first.detector,
        flights=first.flights + second.flights,
        detection_s=first.detection_s + second.detection_s,
        recompute_s=first.recompute_s + second.recompute_s,
        compute_s=first.compute_s + second.compute_s,
        host_compute_s=first.host_compute_s + second.host_compute_s,
        alarms=first.alarms + second.alarms,
        platforms=tuple(sorted({*first.platforms, *second.platforms})),
    )
