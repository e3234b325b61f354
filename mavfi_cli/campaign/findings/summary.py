"""What a campaign has found so far: settings, what faults cost, what protection saves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mavfi_cli.campaign.findings.comparison import RESAMPLES, Comparison, against_golden, protection
from mavfi_cli.campaign.findings.groups import INACTIVE, METRICS, Group, groups
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.statistics.bootstrap import Interval, interval
from mavfi_cli.campaign.statistics.proportions import rate
from mavfi_cli.campaign.statistics.worst_case import WorstCase
from mavfi_cli.campaign.stopping import COUNTED
from mavfi_cli.fi.isolated.outcome import Share


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One setting.

    Attributes:
        name: its labels in one phrase.
        planned: missions on the list.
        errors: that could not begin.
        outcomes: how the flown ones ended.
        injected: what became of the faults.
        success: over golden missions and faults that struck; faults that were not injected or not
            activated are in `inactive` only.
        inactive: success where the fault was not injected or not activated.
        every: success over all flown missions, as the paper counts.
        metrics: of the successful ones among those of `success`, means with bootstrap intervals.
    """

    labels: Mapping[str, Any]
    name: str
    planned: int
    errors: int
    outcomes: Mapping[str, int]
    injected: Mapping[str, int]
    success: Share
    inactive: Share
    every: Share
    metrics: Mapping[str, Interval]


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """A campaign as far as it is flown."""

    name: str
    missions: int
    over: int
    confidence: float
    cells: Sequence[Cell]
    faults: Sequence[Comparison]
    protection: Sequence[Comparison]

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "missing": self.missions - self.over}


def summarise(ledger: Ledger, by: Sequence[str] = (), confidence: float = 0.95) -> Summary:
    """The campaign of a ledger.

    Args:
        by: gather settings by these labels; all labels where none is named.

    Raises:
        UnknownName: no setting has such a label.
    """
    found = groups(ledger, by)
    return Summary(
        name=ledger.meta("name") or ledger.folder.name,
        missions=ledger.planned(),
        over=ledger.over(),
        confidence=confidence,
        cells=[_cell(group, confidence) for group in found],
        faults=against_golden(found, confidence),
        protection=protection(found, confidence),
    )


def _cell(group: Group, confidence: float) -> Cell:
    def success(fates: frozenset[str]) -> Share:
        """Success rate over the missions of some fates."""
        chosen = group.succeeded[group.injected.among(fates)]
        return rate(int(chosen.sum()), len(chosen), confidence)

    def metric(name: str) -> Interval:
        """Mean of a metric over successful missions, with its interval."""
        return interval(group.successes(name), confidence=confidence, resamples=RESAMPLES)

    return Cell(
        labels=group.labels,
        name=group.name,
        planned=group.planned,
        errors=group.errors,
        outcomes=group.outcome.counts(),
        injected=group.injected.counts(),
        success=success(COUNTED),
        inactive=success(INACTIVE),
        every=success(COUNTED | INACTIVE),
        metrics={name: metric(name) for name in METRICS},
    )


def table(summary: Summary) -> list[str]:
    """The settings and the comparisons as lines of text."""
    width = max(len("setting"), *(len(cell.name) for cell in summary.cells))
    interval_name = f"{100 * summary.confidence:g} % interval"
    lines = [
        f"{'setting':<{width}}  {'over':>11}  {'success':>9}  {interval_name:>16}  {'of all':>7}  "
        f"{'mean time':>9}  {'mean distance':>13}  {'mean energy':>11}  {'mean replans':>12}  "
        "inactive"
    ]
    lines += [_cell_line(cell, width) for cell in summary.cells]
    for title, comparisons in (
        ("against the golden flights of the same missions:", summary.faults),
        ("against the same faults without protection:", summary.protection),
    ):
        if comparisons:
            lines += ["", title, *(_comparison_line(each) for each in comparisons)]
    return lines


def _cell_line(cell: Cell, width: int) -> str:
    over = sum(cell.outcomes.values()) + cell.errors
    share = cell.success
    success = f"{share.count}/{share.total}"
    ends = f"{100 * share.low:.1f} to {100 * share.high:.1f} %" if share.total else "-"
    time, distance, energy, replans = (cell.metrics[name].value for name in METRICS)
    every = f"{100 * cell.every.share:.1f} %" if cell.every.total else "-"
    told = [f"{name} {count}" for name, count in cell.outcomes.items() if name != "success"]
    told += [f"{name.replace('_', ' ')} {count}"
             for name, count in cell.injected.items() if name in INACTIVE]  # fmt: skip
    told += [f"could not begin {cell.errors}"] if cell.errors else []
    return (
        f"{cell.name:<{width}}  {f'{over}/{cell.planned}':>11}  {success:>9}  "
        f"{ends:>16}  {every:>7}  {_number(time, 's'):>9}  {_number(distance, 'm'):>13}  "
        f"{_number(energy / 1e3, 'kJ'):>11}  {_number(replans, ''):>12}  {cell.inactive.total:>8}"
        + (f"  ({', '.join(told)})" if told else "")
    )


def _number(value: float, unit: str) -> str:
    return "-" if math.isnan(value) else f"{value:.1f} {unit}".rstrip()


def _comparison_line(each: Comparison) -> str:
    test, time = each.success, each.differences["flight_time_s"]
    parts = [
        f"  {each.name}: {test.pairs} pairs",
        f"success {100 * test.difference:+.1f} points",
        f"p = {each.corrected_p:.3g}",
    ]
    if not math.isnan(time.low):
        parts.append(f"time {time.value:+.2f} s ({time.low:+.2f} to {time.high:+.2f})")
    if not math.isnan(each.over_own.increase):
        parts.append(f"worst {100 * each.over_own.increase:+.1f} % over own golden")
    if not math.isnan(each.over_own.recovered_share):
        parts.append(_recovered(each.over_own))
    if not math.isnan(each.over_mean.recovered_share):
        parts.append(
            f"worst {100 * each.over_mean.increase:+.1f} % over mean golden, "
            f"{_recovered(each.over_mean)}"
        )
    return ", ".join(parts)


def _recovered(worst: WorstCase) -> str:
    return f"recovered {100 * worst.recovered:.1f} points, {100 * worst.recovered_share:.1f} %"
