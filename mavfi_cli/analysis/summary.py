"""Summary of a campaign: settings; cost of faults and benefit of protection mission by mission."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mavfi_cli.analysis.flights import BoolArray, IntArray, known
from mavfi_cli.analysis.groups import (
    INACTIVE,
    METRICS,
    RESAMPLES,
    Group,
    groups,
    matched,
    untreated,
)
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import COUNTED
from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.paired import OWN, WorstCase, holm, mcnemar, worst_case
from mavfi_cli.stats.shares import rate


@dataclass(frozen=True, slots=True)
class _Match:
    """Two settings, their golden setting, and the row indices of their pairs, (m,) in each."""

    first: Group
    second: Group
    golden: Group
    at_first: IntArray
    at_second: IntArray

    @property
    def success(self) -> tuple[BoolArray, BoolArray]:
        """Success of the first and of the second flight of each pair, (m,) each."""
        return self.first.succeeded[self.at_first], self.second.succeeded[self.at_second]

    def differences(self, metric: str) -> FloatArray:
        """Second minus first, over the pairs in which both succeeded and have the metric."""
        first, second = self.success
        change = self.second.metrics[metric][self.at_second]
        return known((change - self.first.metrics[metric][self.at_first])[first & second])

    def worst(self) -> tuple[WorstCase, WorstCase]:
        """Worst cases over own golden flights, and over the mean of these, within the pairs.

        A pair counts only if its golden flight succeeded.
        """
        if self.first.golden:
            golden, sides = self.at_first, [(self.second, self.at_second)]
        else:
            golden = self._golden_of_first()
            sides = [(self.first, self.at_first), (self.second, self.at_second)]
        reference = self._times(self.golden, golden)
        times = [self._times(group, places) for group, places in sides]
        shown = [~np.isnan(reference) & ~np.isnan(each) for each in times]
        used = np.logical_or.reduce(shown)
        _, once = np.unique(golden[used], return_index=True)
        golden_s = reference[used][once]
        pairs = list(zip(times, shown, strict=True))
        return (
            worst_case(OWN, *((each[both] / reference[both]).tolist() for each, both in pairs)),
            worst_case(golden_s.tolist(), *(each[both].tolist() for each, both in pairs)),
        )

    def _golden_of_first(self) -> IntArray:
        """Row index of the golden flight of each pair, (m,); -1 if there is none."""
        own = np.full(self.first.flights.num_rows, -1)
        at_golden, at_faulty = matched(self.golden, self.first)
        own[at_faulty] = at_golden
        return own[self.at_first]

    @staticmethod
    def _times(group: Group, places: IntArray) -> FloatArray:
        """Flight times of successful flights, (m,); NaN for others and at index -1."""
        found = np.full(len(places), np.nan)
        there = (places >= 0) & group.succeeded[places]
        found[there] = group.metrics["flight_time_s"][places[there]]
        return found


def _against_golden(groups: Sequence[Group], confidence: float) -> list[dict[str, Any]]:
    """Compare each setting with faults with the golden setting that shares most pairs.

    Returns:
        Plain values, over the missions that both flew. `first`, `second`: labels of the golden
        setting and of the other; `name`: phrase for the other. `corrected_p`: corrected by Holm
        over all comparisons of this kind. `differences`: second minus first, over the pairs in
        which both succeeded. `over_own`: the largest flight time over that of the golden flight of
        the same mission, both successful. `over_mean`: the longest of the same flights over the
        mean of the same golden ones, as in the paper.
    """
    found = []
    for group in groups:
        golden = _golden_for(group, groups)
        if golden is not None:
            found.append(_Match(golden, group, golden, *matched(golden, group)))
    return _compared(found, confidence)


def _protection(groups: Sequence[Group], confidence: float) -> list[dict[str, Any]]:
    """Compare each protected setting with the unprotected one that has the same faults.

    Returns:
        As `_against_golden`; the worst cases include what protection recovers.
    """
    bare = {
        untreated(group.labels): group for group in groups if not (group.watched or group.golden)
    }
    found = []
    for group in groups:
        if not group.watched:
            continue
        faulty, golden = bare.get(untreated(group.labels)), _golden_for(group, groups)
        if faulty is not None and golden is not None:
            found.append(_Match(faulty, group, golden, *matched(faulty, group)))
    return _compared(found, confidence)


def _golden_for(group: Group, groups: Sequence[Group]) -> Group | None:
    """The golden setting that flew most of this setting's missions; None for a golden one."""
    if group.golden:
        return None
    shared = [
        (np.intersect1d(group.pairs, each.pairs, assume_unique=True).size, -index)
        for index, each in enumerate(groups)
        if each.golden and not each.watched
    ]
    most = max(shared, default=(0, 0))
    return groups[-most[1]] if most[0] else None


def _compared(matches: Sequence[_Match], confidence: float) -> list[dict[str, Any]]:
    matches = [each for each in matches if len(each.at_second)]
    tests = [mcnemar(*each.success) for each in matches]
    corrected = holm([test.p_value for test in tests])
    rows = []
    for each, test, p_value in zip(matches, tests, corrected, strict=True):
        over_own, over_mean = each.worst()
        rows.append(
            {
                "first": each.first.labels,
                "second": each.second.labels,
                "name": each.second.name,
                "success": asdict(test),
                "corrected_p": p_value,
                "differences": {
                    name: asdict(
                        interval(each.differences(name), confidence=confidence, resamples=RESAMPLES)
                    )
                    for name in METRICS
                },
                "over_own": asdict(over_own),
                "over_mean": asdict(over_mean),
            }
        )
    return rows


def summarise(ledger: Ledger, by: Sequence[str] = (), confidence: float = 0.95) -> dict[str, Any]:
    """Summarise the flown missions of a ledger.

    Args:
        by: labels by which settings are grouped; empty means all.

    Returns:
        Plain values. `cells`: one row per setting. `faults`: each setting with faults against the
        golden one, as of `_against_golden`. `protection`: each protected setting against the
        unprotected one, as of `_protection`.

    Raises:
        UnknownName: no setting has such a label.
    """
    found = groups(ledger, by)
    missions, over = ledger.planned(), ledger.over()
    return {
        "name": ledger.meta("name") or ledger.folder.name,
        "missions": missions,
        "over": over,
        "confidence": confidence,
        "cells": [_cell(group, confidence) for group in found],
        "faults": _against_golden(found, confidence),
        "protection": _protection(found, confidence),
        "missing": missions - over,
    }


def _cell(group: Group, confidence: float) -> dict[str, Any]:
    """One setting.

    Returns:
        `name`: its labels in one phrase. `planned`: missions on the list; `errors`: that could not
        begin. `outcomes`: how the flown ones ended. `injected`: what became of the faults.
        `success`: over golden missions and faults that struck; faults that were not injected or
        not activated are in `inactive` only. `every`: success over all flown missions, as the
        paper counts. `metrics`: of the successful ones among those of `success`, means with
        bootstrap intervals.
    """

    def success(fates: frozenset[str]) -> dict[str, Any]:
        chosen = group.succeeded[group.among("injected", fates)]
        return asdict(rate(int(chosen.sum()), len(chosen), confidence))

    return {
        "labels": group.labels,
        "name": group.name,
        "planned": group.planned,
        "errors": group.errors,
        "outcomes": group.counts("outcome"),
        "injected": group.counts("injected"),
        "success": success(COUNTED),
        "inactive": success(INACTIVE),
        "every": success(COUNTED | INACTIVE),
        "metrics": {name: _mean(group, name, confidence) for name in METRICS},
    }


def _mean(group: Group, metric: str, confidence: float) -> dict[str, Any]:
    values = group.successes(metric)
    return asdict(interval(values, confidence=confidence, resamples=RESAMPLES))


def qualities(groups: Sequence[Group], confidence: float = 0.95) -> list[dict[str, Any]]:
    """Every metric of every setting over its successful missions, metric by metric.

    Returns:
        Plain values. `name`: of the setting in one phrase. `mean`: with its bootstrap interval.
        `least`, `median`, `most`: of the flights; not a number where there are none. `difference`:
        to the golden flights of the same missions, with its bootstrap interval; None of golden
        settings.
    """
    beside = {each["name"]: each["differences"] for each in _against_golden(groups, confidence)}
    rows = []
    for metric in METRICS:
        for group in groups:
            values = group.successes(metric)
            ends = np.quantile(values, (0.0, 0.5, 1.0)) if len(values) else np.full(3, np.nan)
            least, middle, most = ends.tolist()
            rows.append(
                {
                    "labels": group.labels,
                    "name": group.name,
                    "metric": metric,
                    "mean": _mean(group, metric, confidence),
                    "least": least,
                    "median": middle,
                    "most": most,
                    "difference": beside.get(group.name, {}).get(metric),
                }
            )
    return rows
