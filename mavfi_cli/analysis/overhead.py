"""The cost of detection and recovery, relative to flight time and to kernel time (Table V).

Relative to flight time, each number of a setting is the mean over the missions that count for the
success rate, with its bootstrap interval. Relative to kernel time, each number covers all
error-free flights of a detector. Kernels and recomputations take the latencies of the flight's
platform. Checks take the time that was measured on the host.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from mavfi_cli.analysis.summary import Group
from mavfi_cli.campaigns.ledger import LEDGER, Ledger
from mavfi_cli.campaigns.missions import Labels
from mavfi_cli.core.errors import MavfiError, RecordError
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.measures import HOST_CHECKS, DetectionCost, FlightRecord
from mavfi_cli.mission.run_folder import RESULT, load_run
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.stats.bootstrap import TABLE_RESAMPLES, interval
from mavfi_cli.stats.shares import Interval

MEASURED = "measured"  # first word of the source of a measured overhead
TIMES = " x "  # separates the name of a platform from the factor in the name of its variant
NEAR = 0.1  # with a latency factor this close to 1, a variant counts as the platform itself
_STAGES = tuple(stage.value for stage in Stage)
# Paths of ledgers: a campaign, an evaluation of detectors, flights of `mavfi vpm --fly`.
_LEDGERS = (LEDGER, f"protected/*/{LEDGER}", f"flights/{LEDGER}")


# Relative to flight time ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightOverhead:
    """The overhead of one detector, averaged over the flights of one setting of a campaign.

    Shares are relative to flight time: 0.01 is 1 %.

    Attributes:
        labels: labels of the setting, including the detector.
        flights: number of flights in which the detector checked messages.
        checks_per_s: checks per second of flight.
        check_host_s: mean time of a check on the host of the flight.
        detection_host_share: time of all checks on that host, divided by the flight time.
        recomputations: number of recomputations in all flights, by stage.
        recovery_share: simulated latency of recomputations, divided by the flight time, by stage.
        recovery_share_in_all: sum of `recovery_share` over the stages.
        share_in_all: share of detection plus recovery. It adds host time and simulated time, as the
            paper does.
    """

    labels: Labels
    flights: int
    checks_per_s: Interval
    check_host_s: Interval
    detection_host_share: Interval
    recomputations: Mapping[str, float]
    recovery_share: Mapping[str, Interval]
    recovery_share_in_all: Interval
    share_in_all: Interval

    @classmethod
    def of(
        cls,
        labels: Labels,
        weighted: Sequence[tuple[DetectionCost, float]],
        confidence: float,
    ) -> Self:
        """Average the costs of one detector over its flights.

        Args:
            labels: labels of the setting.
            weighted: cost and weight of each flight; at least one is required.
        """
        costs = [cost for cost, _ in weighted]
        weights = np.array([weight for _, weight in weighted])

        def mean(values: Iterable[float]) -> Interval:
            return interval(
                [*values],
                confidence=confidence,
                resamples=TABLE_RESAMPLES,
                weights=weights,
            )

        return cls(
            labels={**labels, "detector": costs[0].detector},
            flights=len(costs),
            checks_per_s=mean(cost.checks / cost.flight_s for cost in costs),
            check_host_s=mean(cost.check_host_s for cost in costs),
            detection_host_share=mean(cost.detection_share for cost in costs),
            recomputations={
                stage: math.fsum(cost.recomputations[stage] for cost in costs) for stage in _STAGES
            },
            recovery_share={
                stage: mean(cost.recovery_s[stage] / cost.flight_s for cost in costs)
                for stage in _STAGES
            },
            recovery_share_in_all=mean(cost.recovery_share for cost in costs),
            share_in_all=mean(cost.detection_share + cost.recovery_share for cost in costs),
        )


def flight_overheads(
    ledger: Ledger, groups: Sequence[Group], confidence: float = 0.95
) -> list[FlightOverhead]:
    """Compute the overhead of each detector in each of the settings.

    The result has one row per setting and detector. Settings without a detector are omitted.

    Raises:
        RecordError: the campaign was opened from an export, which contains no records of flights.
    """
    rows = []
    for group in groups:
        costs: dict[str, list[tuple[DetectionCost, float]]] = {}
        for mission in ledger.results(group.codes("number")[group.counted].tolist()):
            cost = DetectionCost.of(mission.flight)
            if cost is not None:
                costs.setdefault(cost.detector, []).append((cost, mission.weight))
        rows += [FlightOverhead.of(group.labels, costs[name], confidence) for name in sorted(costs)]
    return rows


# Relative to kernel time -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputeOverhead:
    """The compute overhead of a detector: times and counts, summed over its flights.

    Attributes:
        detection_s: host time of all checks of the gate.
        recompute_s: simulated time of recomputations. Each one takes the mean latency of the
            kernels of its stage.
        compute_s: simulated time of all kernels, including recomputations.
        host_compute_s: host time of all kernels.
        alarms: number of alarms that led to a recomputation.
        platforms: names of the flights' platforms, in alphabetical order.
        left_out: number of ignored flights on other platforms.
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
        """Overhead relative to the compute time without detection and recovery; 0.01 is 1 %."""
        return (self.detection_s + self.recompute_s) / (self.compute_s - self.recompute_s)

    @property
    def checks_share(self) -> float:
        """The part of `share` that is due to checks. The rest is due to recomputations."""
        return self.detection_s / (self.compute_s - self.recompute_s)

    @property
    def checks_host_share(self) -> float:
        """The time of all checks divided by that of all kernels, both measured on the host."""
        return self.detection_s / self.host_compute_s

    @classmethod
    def of(
        cls, records: Iterable[FlightRecord], platform: str | None = None
    ) -> dict[str, ComputeOverhead]:
        """Compute the overhead of each detector in these flights, keyed by the detector's name.

        Flights with a fault are ignored, because the fault may cause their alarms.

        Args:
            platform: use only flights on this platform; None uses all.
        """
        counted: dict[str, list[DetectionCost]] = {}
        left_out: Counter[str] = Counter()
        names: dict[str, str] = {}  # platform in a mission -> name
        for cost in filter(None, map(DetectionCost.of, records)):
            if cost.faulty or cost.compute_s <= cost.recovered_s or cost.host_compute_s <= 0.0:
                continue
            name = names.setdefault(cost.platform, _platform_name(cost.platform))
            if platform is None or _same(name, platform):
                counted.setdefault(cost.detector, []).append(cost)
            else:
                left_out[cost.detector] += 1
        return {
            detector: cls(
                detector=detector,
                flights=len(costs),
                detection_s=sum(cost.checks_host_s for cost in costs),
                recompute_s=sum(cost.recovered_s for cost in costs),
                compute_s=sum(cost.compute_s for cost in costs),
                host_compute_s=sum(cost.host_compute_s for cost in costs),
                alarms=sum(round(math.fsum(cost.recomputations.values())) for cost in costs),
                platforms=tuple(sorted({names[cost.platform] for cost in costs})),
                left_out=left_out[detector],
            )
            for detector, costs in counted.items()
        }

    def describe(self, where: str) -> str:
        """Describe in one phrase where the overhead was measured, and its parts in per cent.

        Args:
            where: name of the place in which the flights are recorded, such as a folder.
        """
        again = self.share - self.checks_share
        left = f" ({self.left_out} on other platforms left out)" if self.left_out else ""
        return (
            f"{MEASURED} in {self.flights} {'flight' if self.flights == 1 else 'flights'} of "
            f"{where} on {' and '.join(self.platforms)}{left}: checks "
            f"{100.0 * self.checks_share:.4g} %, {self.alarms} "
            f"{'recomputation' if self.alarms == 1 else 'recomputations'} {100.0 * again:.4g} %; "
            f"{HOST_CHECKS}"
        )


def _platform_name(called: str) -> str:
    """Return the name of a platform that a record gives by name or by the path of its file.

    For a path, this is the name in the file, or the file's stem if the file cannot be loaded.
    """
    if not called.endswith(".toml"):
        return called
    try:
        return load_platform(called).name
    except MavfiError:
        return Path(called).stem


def _same(name: str, platform: str) -> bool:
    """Return True if `name` is the platform, or a variant of it with a latency factor near 1."""
    base, times, factor = name.rpartition(TIMES)
    if name == platform or not times or base != platform:
        return name == platform
    try:
        return abs(float(factor) - 1.0) <= NEAR
    except ValueError:  # a name that the user chose
        return False


def recorded_overheads(
    path: Path, detectors: Sequence[str], platform: str | None = None
) -> dict[str, ComputeOverhead]:
    """Return the overhead of each detector in the error-free flights at `path`, keyed by its name.

    Args:
        path: a run folder, a folder of run folders, the folder of a campaign, or the output folder
            of a command that flies missions.
        detectors: names of the detectors; those that did not fly are omitted from the result.
        platform: use only flights on this platform; None uses all.

    Raises:
        RecordError: no error-free flight with one of the detectors is recorded on the platform. The
            message lists the detectors and platforms that are recorded.
    """
    recorded = ComputeOverhead.of(_records(path), platform)
    known = {name: overhead for name, overhead in recorded.items() if name in detectors}
    if not known:
        everywhere = ComputeOverhead.of(_records(path)).values()
        there = [
            f"{overhead.detector} on {' and '.join(overhead.platforms)}" for overhead in everywhere
        ]
        only = f", only {', '.join(there)}" if there else ""
        wanted = f" on {platform} (--platform)" if platform else ""
        flags = f"--platform {platform} " if platform else ""
        raise RecordError(
            f"{path}: no error-free flight with {' or '.join(detectors)}{wanted} is recorded "
            f"there{only}; mavfi fly {flags}--detector {detectors[-1]} records one"
        )
    return known


def _records(path: Path) -> Iterator[FlightRecord]:
    """Yield the flight records at `path`: of one run, of a folder of runs, or of campaigns."""
    if path.is_file() or (path / RESULT).is_file():
        yield load_run(path).record
        return
    for ledger in (file for pattern in _LEDGERS for file in sorted(path.glob(pattern))):
        with Ledger(ledger.parent) as opened:
            yield from (entry.flight for entry in opened.results())
    for run in sorted(path.glob(f"*/{RESULT}")):
        yield load_run(run).record
