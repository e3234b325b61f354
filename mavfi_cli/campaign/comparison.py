"""Settings against each other, mission by mission: what faults cost, and what protection saves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mavfi_cli.campaign.groups import Group
from mavfi_cli.campaign.statistics.bootstrap import Interval, interval
from mavfi_cli.campaign.statistics.paired import McNemar, holm, mcnemar
from mavfi_cli.campaign.statistics.worst_case import WorstCase, worst_case
from mavfi_cli.campaign.stopping import COUNTED

METRICS = ("flight_time_s", "distance_m", "energy_regression_j", "replans")
RESAMPLES = 1999
TREATMENT = ("setting", "detector", "protect")  # labels in which protected flights differ
Places = list[tuple[int, int]]  # rows of the first and of the second, a pair of missions each


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
    first: Group
    second: Group
    places: Places
    golden: Group

    def columns(self, name: str | None = None) -> tuple[Any, Any]:
        """A column of both, a row a pair; their successes where none is named."""
        at = np.array(self.places).T
        if name is None:
            return self.first.succeeded[at[0]], self.second.succeeded[at[1]]
        return self.first.numbers(name)[at[0]], self.second.numbers(name)[at[1]]


def against_golden(groups: Sequence[Group], confidence: float = 0.95) -> list[Comparison]:
    """Every setting with faults against the golden one with which it shares most pairs."""
    found = []
    for group in groups:
        golden = _golden_for(group, groups)
        if golden is not None and (pairs := _paired(golden, group)):
            found.append(_Match(golden, group, pairs, golden))
    return _compared(found, confidence, protected=False)


def protection(groups: Sequence[Group], confidence: float = 0.95) -> list[Comparison]:
    """Every protected setting against the unprotected one with the same faults."""
    bare = {_untreated(group): group for group in groups if not (_protected(group) or group.golden)}
    found = []
    for group in filter(_protected, groups):
        faulty, golden = bare.get(_untreated(group)), _golden_for(group, groups)
        if faulty is None or golden is None:
            continue
        if pairs := _paired(faulty, group):
            found.append(_Match(faulty, group, pairs, golden))
    return _compared(found, confidence, protected=True)


def _protected(group: Group) -> bool:
    return bool(group.labels.get("detector") not in (None, "none"))


def _untreated(group: Group) -> frozenset[tuple[str, Any]]:
    return frozenset((k, v) for k, v in group.labels.items() if k not in TREATMENT)


def _golden_for(group: Group, groups: Sequence[Group]) -> Group | None:
    """The golden setting that flew most of this setting's missions; None of itself golden."""
    if group.golden:
        return None
    shared = [
        (len(group.pairs.keys() & each.pairs.keys()), -index)
        for index, each in enumerate(groups)
        if each.golden and not _protected(each)
    ]
    most = max(shared, default=(0, 0))
    return groups[-most[1]] if most[0] else None


def _paired(first: Group, second: Group) -> Places:
    """Missions of equal pairs, in the order of the list; one golden flight serves several."""
    found: Places = []
    for pair, places in second.pairs.items():
        others = first.pairs.get(pair, [])
        if first.golden:
            others = others[:1] * len(places)
        found += zip(others, places, strict=False)  # as many as both have
    return sorted(found, key=lambda pair: pair[1])


def _compared(matches: Sequence[_Match], confidence: float, *, protected: bool) -> list[Comparison]:
    tests = [
        mcnemar(zip(*(column.tolist() for column in each.columns()), strict=True))
        for each in matches
    ]
    corrected = holm([test.p_value for test in tests])
    found = []
    for each, test, p in zip(matches, tests, corrected, strict=True):
        golden, first, second = (
            group.successes("flight_time_s", COUNTED).tolist()
            for group in (each.golden, each.first, each.second)
        )
        found.append(
            Comparison(
                first=each.first.labels,
                second=each.second.labels,
                success=test,
                corrected_p=p,
                differences={name: _difference(each, name, confidence) for name in METRICS},
                worst=worst_case(golden, first, second)
                if protected
                else worst_case(golden, second),
            )
        )
    return found


def _difference(match: _Match, name: str, confidence: float) -> Interval:
    a, b = match.columns(name)
    won_a, won_b = match.columns()
    differences = (b - a)[won_a & won_b]
    known = differences[~np.isnan(differences)]
    return interval(known, confidence=confidence, resamples=RESAMPLES)
