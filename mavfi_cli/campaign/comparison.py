"""Settings against each other, mission by mission: what faults cost, and what protection saves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mavfi_cli.campaign.groups import METRICS, BoolArray, Group, IntArray, matched, untreated
from mavfi_cli.campaign.statistics.bootstrap import Interval, interval
from mavfi_cli.campaign.statistics.paired import McNemar, holm, mcnemar
from mavfi_cli.campaign.statistics.worst_case import WorstCase, worst_case
from mavfi_cli.core.types import FloatArray

RESAMPLES = 1999


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two settings over the missions that both flew.

    Attributes:
        first, second: their labels; the first is golden, or faulty where the second is protected.
        corrected_p: of the family of all comparisons of this kind, by Holm.
        differences: second minus first, over the pairs in which both succeeded.
        worst: of the flight time; with what protection recovers of it.
    """

    first: Mapping[str, Any]
    second: Mapping[str, Any]
    success: McNemar
    corrected_p: float
    differences: Mapping[str, Interval]
    worst: WorstCase


@dataclass(frozen=True, slots=True)
class _Match:
    """Two settings, the golden one of both, and the places of their pairs, (m,) in each."""

    first: Group
    second: Group
    golden: Group
    at_first: IntArray
    at_second: IntArray

    @property
    def success(self) -> tuple[BoolArray, BoolArray]:
        """Whether each of a pair succeeded, (m,) twice."""
        return self.first.succeeded[self.at_first], self.second.succeeded[self.at_second]

    def differences(self, metric: str) -> FloatArray:
        """Second minus first, of the pairs in which both succeeded and have the metric."""
        first, second = self.success
        change = self.second.metrics[metric][self.at_second]
        change = (change - self.first.metrics[metric][self.at_first])[first & second]
        return change[~np.isnan(change)]


def against_golden(groups: Sequence[Group], confidence: float = 0.95) -> list[Comparison]:
    """Every setting with faults against the golden one with which it shares most pairs."""
    found = []
    for group in groups:
        golden = _golden_for(group, groups)
        if golden is not None:
            found.append(_Match(golden, group, golden, *matched(golden, group)))
    return _compared(found, confidence, protected=False)


def protection(groups: Sequence[Group], confidence: float = 0.95) -> list[Comparison]:
    """Every protected setting against the unprotected one with the same faults."""
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
    return _compared(found, confidence, protected=True)


def _golden_for(group: Group, groups: Sequence[Group]) -> Group | None:
    """The golden setting that flew most of this setting's missions; None of itself golden."""
    if group.golden:
        return None
    shared = [
        (int((group.flown_pairs & each.flown_pairs).sum()), -index)
        for index, each in enumerate(groups)
        if each.golden and not each.watched
    ]
    most = max(shared, default=(0, 0))
    return groups[-most[1]] if most[0] else None


def _compared(matches: Sequence[_Match], confidence: float, *, protected: bool) -> list[Comparison]:
    matches = [each for each in matches if len(each.at_second)]
    tests = [
        mcnemar(zip(*(column.tolist() for column in each.success), strict=True)) for each in matches
    ]
    corrected = holm([test.p_value for test in tests])
    found = []
    for each, test, p in zip(matches, tests, corrected, strict=True):
        golden, first, second = (
            group.successes("flight_time_s").tolist()
            for group in (each.golden, each.first, each.second)
        )
        found.append(
            Comparison(
                first=each.first.labels,
                second=each.second.labels,
                success=test,
                corrected_p=p,
                differences={
                    name: interval(
                        each.differences(name), confidence=confidence, resamples=RESAMPLES
                    )
                    for name in METRICS
                },
                worst=worst_case(golden, first, second)
                if protected
                else worst_case(golden, second),
            )
        )
    return found
