"""What a campaign has found so far: settings, what faults cost, what protection saves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mavfi_cli.analysis.comparison import RESAMPLES, PairedComparison, against_golden, protection
from mavfi_cli.analysis.groups import INACTIVE, METRICS, Group, groups
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.outcome import COUNTED
from mavfi_cli.stats.bootstrap import Interval, interval
from mavfi_cli.stats.shares import Share, rate


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
    faults: Sequence[PairedComparison]
    protection: Sequence[PairedComparison]

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
        chosen = group.succeeded[group.among("injected", fates)]
        return rate(int(chosen.sum()), len(chosen), confidence)

    return Cell(
        labels=group.labels,
        name=group.name,
        planned=group.planned,
        errors=group.errors,
        outcomes=group.counts("outcome"),
        injected=group.counts("injected"),
        success=success(COUNTED),
        inactive=success(INACTIVE),
        every=success(COUNTED | INACTIVE),
        metrics={name: _mean(group, name, confidence) for name in METRICS},
    )


def _mean(group: Group, metric: str, confidence: float) -> Interval:
    """A metric over the successful missions, with its bootstrap interval."""
    return interval(group.successes(metric), confidence=confidence, resamples=RESAMPLES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """One metric of one setting, over its successful missions.

    Attributes:
        name: of the setting in one phrase.
        mean: with its bootstrap interval.
        least, median, most: of the flights; not a number where there are none.
        difference: to the golden flights of the same missions, with its bootstrap interval; None
            of golden settings.
    """

    labels: Mapping[str, Any]
    name: str
    metric: str
    mean: Interval
    least: float
    median: float
    most: float
    difference: Interval | None


def qualities(groups: Sequence[Group], confidence: float = 0.95) -> list[Quality]:
    """Every metric of every setting, metric by metric."""
    beside = {each.name: each for each in against_golden(groups, confidence)}
    return [
        _quality(group, metric, beside.get(group.name), confidence)
        for metric in METRICS
        for group in groups
    ]


def _quality(
    group: Group, metric: str, compared: PairedComparison | None, confidence: float
) -> Quality:
    values = group.successes(metric)
    quantiles = np.quantile(values, (0.0, 0.5, 1.0)) if len(values) else np.full(3, np.nan)
    least, median, most = quantiles.tolist()
    return Quality(
        labels=group.labels,
        name=group.name,
        metric=metric,
        mean=_mean(group, metric, confidence),
        least=least,
        median=median,
        most=most,
        difference=None if compared is None else compared.differences[metric],
    )
