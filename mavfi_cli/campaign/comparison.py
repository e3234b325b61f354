"""Settings against each other, mission by mission: what faults cost, and what protection saves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mavfi_cli.campaign.groups import Group, Row, pair_of_row, succeeded, value
from mavfi_cli.campaign.statistics.bootstrap import Interval, interval
from mavfi_cli.campaign.statistics.paired import McNemar, holm, mcnemar
from mavfi_cli.campaign.statistics.worst_case import WorstCase, worst_case
from mavfi_cli.campaign.stopping import COUNTED

METRICS = ("flight_time_s", "distance_m", "energy_regression_j", "replans")
RESAMPLES = 1999
TREATMENT = ("setting", "detector", "protect")  # labels in which protected flights differ
Pairs = list[tuple[Row, Row]]


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
    pairs: Pairs
    golden: Group


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
        (len(group.pairs & each.pairs), -index)
        for index, each in enumerate(groups)
        if each.golden and not _protected(each)
    ]
    most = max(shared, default=(0, 0))
    return groups[-most[1]] if most[0] else None


def _paired(first: Group, second: Group) -> Pairs:
    """Missions of equal pairs, in the order of the list; one golden flight serves several."""
    waiting: dict[str, list[Row]] = defaultdict(list)
    for row in first.of(COUNTED):
        waiting[pair_of_row(row)].append(row)
    taken: dict[str, int] = defaultdict(int)
    found: Pairs = []
    for row in second.of(COUNTED):
        pair = pair_of_row(row)
        candidates = waiting.get(pair, [])
        if candidates and (first.golden or taken[pair] < len(candidates)):
            found.append((candidates[min(taken[pair], len(candidates) - 1)], row))
            taken[pair] += 1
    return found


def _compared(matches: Sequence[_Match], confidence: float, *, protected: bool) -> list[Comparison]:
    tests = [mcnemar((succeeded(a), succeeded(b)) for a, b in each.pairs) for each in matches]
    corrected = holm([test.p_value for test in tests])
    found = []
    for each, test, p in zip(matches, tests, corrected, strict=True):
        times = [group.successes("flight_time_s", COUNTED) for group in (each.first, each.second)]
        golden = each.golden.successes("flight_time_s", COUNTED)
        found.append(
            Comparison(
                first=each.first.labels,
                second=each.second.labels,
                success=test,
                corrected_p=p,
                differences={name: _difference(each.pairs, name, confidence) for name in METRICS},
                worst=worst_case(golden, *times) if protected else worst_case(golden, times[1]),
            )
        )
    return found


def _difference(pairs: Pairs, name: str, confidence: float) -> Interval:
    differences = [
        float(value(b, name)) - float(value(a, name))
        for a, b in pairs
        if succeeded(a) and succeeded(b) and None not in (value(a, name), value(b, name))
    ]
    return interval(differences, confidence=confidence, resamples=RESAMPLES)
