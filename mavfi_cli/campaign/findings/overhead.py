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
from mavfi_cli.campaign.findings.setting_columns import SettingColumns
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import label_text
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.record.detection_cost import HOST_CHECKS, DetectionCost, detection_cost
from mavfi_cli.stats.bootstrap import Interval, interval

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
    settings = SettingColumns.of([each.labels for each in found])
    sure = f"({100 * confidence:g} % interval)"
    named = [(each, (each.labels, label_text(each.labels))) for each in found]
    return [
        "", "detection: checks, host time", *settings.told(),
        *settings.table(
            ["flights", "a second", f"us each {sure}", f"% of time {sure}"],
            [(*name, _detection_cells(each)) for each, name in named],
        ),
        f"({HOST_CHECKS})",
        "", "recovery: % of flight time, simulated",
        *settings.table(
            ["times", *_STAGES, f"in all {sure}", f"+ checks {sure}"],
            [(*name, _recovery_cells(each)) for each, name in named],
        ),
    ]  # fmt: skip


def _detection_cells(each: Overhead) -> list[str]:
    return [
        f"{each.flights}",
        f"{each.checks_per_s.value:.1f}",
        f"{1e6 * each.check_host_s.value:.2f}{_ends(each.check_host_s, 1e6, 2)}",
        f"{_percent(each.detection_host_share.value)}{_ends(each.detection_host_share)}",
    ]


def _recovery_cells(each: Overhead) -> list[str]:
    recovery, both = each.recovery_share_in_all, each.share_in_all
    return [
        f"{round(math.fsum(each.recomputations.values()))}",
        *(_percent(each.recovery_share[stage].value) for stage in _STAGES),
        f"{_percent(recovery.value)}{_ends(recovery)}",
        f"{_percent(both.value)}{_ends(both)}",
    ]


def _percent(share: float) -> str:
    """Per cent with four digits, as in the paper's table; what is less but not nothing as "<"."""
    return "<0.0001" if 0.0 < share < 0.5e-6 else f"{100 * share:.4f}"


def _ends(found: Interval, scale: float = 100.0, digits: int = 4) -> str:
    """The interval beside a value; nothing where there is none."""
    if math.isnan(found.low):
        return ""
    return f" ({scale * found.low:.{digits}f} to {scale * found.high:.{digits}f})"
