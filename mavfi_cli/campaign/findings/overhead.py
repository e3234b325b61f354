"""What detection and recovery cost by setting, as shares of the flight time (paper, Table V).

A mission is the unit: each number is the mean over the missions, with its bootstrap interval. The
missions are those of the success rate; one whose fault did nothing had nothing to recover from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mavfi_cli.campaign.findings.comparison import RESAMPLES
from mavfi_cli.campaign.findings.groups import Group
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import label_text
from mavfi_cli.campaign.statistics.bootstrap import Interval, interval
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.record.detection_cost import HOST_CHECKS, DetectionCost, detection_cost

_STAGES = tuple(stage.value for stage in Stage)


@dataclass(frozen=True, slots=True, kw_only=True)
class Overhead:
    """One detector in one setting. Shares are of the flight time: 0.01 is one per cent.

    Attributes:
        labels: of the setting, with the detector.
        flights: in which it checked anything.
        checks_per_s: of flight time.
        check_host_s: mean time of a check on the host that flew.
        detection_host_share: all checks, time of the host that flew.
        recomputations: in all flights, by stage.
        recovery_share: simulated latency of what was computed again, by stage.
        recovery_share_in_all: of all stages.
        share_in_all: detection and recovery, host time and simulated time added up as the paper
            does.
    """

    labels: Mapping[str, Any]
    flights: int
    checks_per_s: Interval
    check_host_s: Interval
    detection_host_share: Interval
    recomputations: Mapping[str, float]
    recovery_share: Mapping[str, Interval]
    recovery_share_in_all: Interval
    share_in_all: Interval

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def overheads(ledger: Ledger, found: Sequence[Group], confidence: float = 0.95) -> list[Overhead]:
    """Every setting with a detector; a setting that gathers several has a row for each.

    Args:
        found: the settings of the ledger.
    """
    rows = []
    for group in found:
        flown: dict[str, list[DetectionCost]] = {}
        for each in ledger.results(group.number[group.counted].tolist()):
            cost = detection_cost(each.result)
            if cost is not None:
                flown.setdefault(cost.detector, []).append(cost)
        rows += [_overhead(group.labels, flown[name], confidence) for name in sorted(flown)]
    return rows


def _overhead(
    labels: Mapping[str, Any], costs: Sequence[DetectionCost], confidence: float
) -> Overhead:
    def over(values: Sequence[float]) -> Interval:
        """Mean over the flights, with its interval."""
        return interval(values, confidence=confidence, resamples=RESAMPLES)

    return Overhead(
        labels={**labels, "detector": costs[0].detector},
        flights=len(costs),
        checks_per_s=over([cost.checks / cost.flight_s for cost in costs]),
        check_host_s=over([cost.check_host_s for cost in costs]),
        detection_host_share=over([cost.detection_share for cost in costs]),
        recomputations={
            stage: math.fsum(cost.recomputations[stage] for cost in costs) for stage in _STAGES
        },
        recovery_share={
            stage: over([cost.recovery_s[stage] / cost.flight_s for cost in costs])
            for stage in _STAGES
        },
        recovery_share_in_all=over([cost.recovery_share for cost in costs]),
        share_in_all=over([cost.detection_share + cost.recovery_share for cost in costs]),
    )


def lines(found: Sequence[Overhead], confidence: float = 0.95) -> list[str]:
    """A table of detection, measured on the host, and one of recovery, simulated."""
    if not found:
        return ["", "overhead: no flight with a detector"]
    detection, recovery = "detection: checks, host time", "recovery: % of flight time, simulated"
    width = max(len(recovery), *(len(label_text(each.labels)) for each in found))
    sure = f"{100 * confidence:g} % interval"
    stages = "".join(f"  {stage:>10}" for stage in _STAGES)
    told = ["", f"{detection:<{width}}  {'flights':>7}  {'a second':>8}  {'us each':>8}  "
            f"{sure:>20}  {'% of time':>9}  {sure:>20}"]  # fmt: skip
    told += [_detection_line(each, width) for each in found]
    told += [f"({HOST_CHECKS})"]
    told += ["", f"{recovery:<{width}}  {'times':>7}{stages}  {'in all':>8}  {sure:>20}  "
             f"{'+ checks':>9}  {sure:>20}"]  # fmt: skip
    return told + [_recovery_line(each, width) for each in found]


def _detection_line(each: Overhead, width: int) -> str:
    return (
        f"{label_text(each.labels):<{width}}  {each.flights:>7}  {each.checks_per_s.value:>8.1f}  "
        f"{1e6 * each.check_host_s.value:>8.2f}  {_ends(each.check_host_s, 1e6, 2):>20}  "
        f"{_percent(each.detection_host_share.value):>9}  {_ends(each.detection_host_share):>20}"
    )


def _recovery_line(each: Overhead, width: int) -> str:
    times = round(math.fsum(each.recomputations.values()))
    stages = "".join(f"  {_percent(each.recovery_share[stage].value):>10}" for stage in _STAGES)
    recovery, both = each.recovery_share_in_all, each.share_in_all
    return (
        f"{label_text(each.labels):<{width}}  {times:>7}{stages}  "
        f"{_percent(recovery.value):>8}  {_ends(recovery):>20}  "
        f"{_percent(both.value):>9}  {_ends(both):>20}"
    )


def _percent(share: float) -> str:
    """Per cent with four digits, as in the paper's table; what is less but not nothing as "<"."""
    return "<0.0001" if 0.0 < share < 0.5e-6 else f"{100 * share:.4f}"


def _ends(found: Interval, scale: float = 100.0, digits: int = 4) -> str:
    if math.isnan(found.low):
        return "-"
    return f"{scale * found.low:.{digits}f} to {scale * found.high:.{digits}f}"
