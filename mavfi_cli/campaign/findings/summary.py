"""What a campaign has found so far: settings, what faults cost, what protection saves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mavfi_cli.campaign.findings.comparison import RESAMPLES, Comparison, against_golden, protection
from mavfi_cli.campaign.findings.groups import INACTIVE, METRICS, Group, groups
from mavfi_cli.campaign.findings.setting_columns import SettingColumns
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.stopping import COUNTED
from mavfi_cli.stats.bootstrap import Interval, interval
from mavfi_cli.stats.shares import Share, rate
from mavfi_cli.stats.worst_case import WorstCase


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
    settings = SettingColumns.of([cell.labels for cell in summary.cells])
    fates = [(cell.labels, cell.name, _fate_cells(cell)) for cell in summary.cells]
    means = [(cell.labels, cell.name, _mean_cells(cell)) for cell in summary.cells]
    sure = f"{100 * summary.confidence:g} % interval"
    otherwise = ["ended otherwise"] if any(cells[-1] for _, _, cells in fates) else []
    lines = [
        *settings.told(),
        *settings.table(["over", "success", sure, "of all", "inactive", *otherwise], fates),
        "",
        *settings.table(["mean time", "mean distance", "mean energy", "mean replans"], means),
    ]
    for title, comparisons in (
        ("against the golden flights of the same missions:", summary.faults),
        ("against the same faults without protection:", summary.protection),
    ):
        if comparisons:
            lines += ["", title, *_comparison_table(settings, comparisons)]
    return lines


def _fate_cells(cell: Cell) -> list[str]:
    over = sum(cell.outcomes.values()) + cell.errors
    share = cell.success
    ends = f"{100 * share.low:.1f} to {100 * share.high:.1f} %" if share.total else "-"
    every = f"{100 * cell.every.share:.1f} %" if cell.every.total else "-"
    told = [f"{name} {count}" for name, count in cell.outcomes.items() if name != "success"]
    told += [f"{name.replace('_', ' ')} {count}"
             for name, count in cell.injected.items() if name in INACTIVE]  # fmt: skip
    told += [f"could not begin {cell.errors}"] if cell.errors else []
    return [f"{over}/{cell.planned}", f"{share.count}/{share.total}", ends, every,
            str(cell.inactive.total), ", ".join(told)]  # fmt: skip


def _mean_cells(cell: Cell) -> list[str]:
    time, distance, energy, replans = (cell.metrics[name].value for name in METRICS)
    return [_number(time, "s"), _number(distance, "m"), _number(energy / 1e3, "kJ"),
            _number(replans, "")]  # fmt: skip


def _number(value: float, unit: str) -> str:
    return "-" if math.isnan(value) else f"{value:.1f} {unit}".rstrip()


def _comparison_table(settings: SettingColumns, found: Sequence[Comparison]) -> list[str]:
    """A line a comparison; without the columns in which none has a value."""
    head = ["pairs", "success, points", "p", "time, s", "worst over own golden",
            "worst over mean golden"]  # fmt: skip
    cells = [_comparison_cells(each) for each in found]
    used = [place for place, column in enumerate(zip(*cells, strict=True)) if any(column)]
    rows = [
        (each.second, each.name, [row[place] for place in used])
        for each, row in zip(found, cells, strict=True)
    ]
    return settings.table([head[place] for place in used], rows)


def _comparison_cells(each: Comparison) -> list[str]:
    """Success, time, and worst cases; that over the mean golden flight beside protection only."""
    test, time, mean = each.success, each.differences["flight_time_s"], each.over_mean
    return [
        f"{test.pairs}",
        f"{100 * test.difference:+.1f}",
        f"{each.corrected_p:.3g}",
        "" if math.isnan(time.low) else f"{time.value:+.2f} ({time.low:+.2f} to {time.high:+.2f})",
        _worst(each.over_own),
        "" if math.isnan(mean.recovered_share) else _worst(mean),
    ]


def _worst(worst: WorstCase) -> str:
    if math.isnan(worst.increase):
        return ""
    told = f"{100 * worst.increase:+.1f} %"
    if math.isnan(worst.recovered_share):
        return told
    recovered = f"{100 * worst.recovered:.1f} points, {100 * worst.recovered_share:.1f} %"
    return f"{told}, recovered {recovered}"
