"""Summary of a campaign: settings; cost of faults and benefit of protection mission by mission.

Reads the short rows of the ledger, because a campaign may have a million missions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import BoolArray, IntArray, known, numbers
from mavfi_cli.analysis.pairs import partners
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import COUNTED, Injected, canonical, label_text
from mavfi_cli.core.errors import UnknownName
from mavfi_cli.core.types import FloatArray, Outcome
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.paired import OWN, McNemar, holm, worst_case
from mavfi_cli.stats.shares import rate

RESAMPLES = 1999
METRICS = ("flight_time_s", "distance_m", "energy_regression_j", "replans")
# Labels in which protected flights differ from unprotected ones.
TREATMENT = ("setting", "detector", "protect", "any_stack", "watch")
INACTIVE = frozenset(each.value for each in Injected) - COUNTED
_WHOLE = ("cell", "number")
_WORDS = ("outcome", "injected", "pair")


@dataclass(frozen=True)  # no slots: cached properties need a dict
class Group:
    """Missions that are counted together.

    Attributes:
        labels: common labels.
        lacked: grouping labels that these missions lack.
        planned, errors: missions on the list; those of them that could not begin.
        watched: whether a detector watches all of them.
        flights: the flown ones, in the order of the list: `number`, `outcome`, `injected`, METRICS;
            `pair` and `strike` are codes: of what golden, faulty and protected flights share, and
            of what the labels say but for the treatment, which is the fault.
    """

    labels: Mapping[str, Any]
    lacked: Sequence[str]
    planned: int
    errors: int
    watched: bool
    flights: pa.Table

    @property
    def name(self) -> str:
        """A phrase of their labels and of the grouping labels that they lack."""
        if not self.lacked or "setting" in self.labels:  # its name identifies it
            return label_text(self.labels)
        less = "golden" if self.flights.num_rows and self.golden else f"no {', '.join(self.lacked)}"
        return f"{label_text(self.labels)} {less}" if self.labels else less

    @cached_property
    def metrics(self) -> Mapping[str, FloatArray]:
        """METRICS, (n,) each; NaN if a mission has none."""
        return {name: numbers(self.flights, name) for name in METRICS}

    @cached_property
    def succeeded(self) -> BoolArray:
        """Whether each mission reached its goal, (n,)."""
        return self.among("outcome", (Outcome.SUCCESS.value,))

    @cached_property
    def counted(self) -> BoolArray:
        """Whether each mission is golden or its fault struck, (n,)."""
        return self.among("injected", COUNTED)

    @cached_property
    def golden(self) -> bool:
        """Whether the missions have no fault."""
        return bool(self.among("injected", (Injected.GOLDEN.value,)).all())

    @cached_property
    def pairs(self) -> IntArray:
        """The distinct pairs of the counted missions."""
        return np.unique(self.codes("pair")[self.counted])

    def codes(self, name: str) -> IntArray:
        """An integer column, (n,)."""
        return np.asarray(self.flights[name].to_numpy(), dtype=np.int64)

    def among(self, name: str, words: Iterable[str]) -> BoolArray:
        """Whether each mission has one of these words in a text column, (n,)."""
        found = pc.is_in(self.flights[name], value_set=pa.array(sorted(words), pa.string()))
        return np.asarray(found.to_numpy(), dtype=bool)

    def counts(self, name: str) -> dict[str, int]:
        """Number of occurrences of each word in a column."""
        found = pc.value_counts(self.flights[name]).to_pylist()
        return dict(sorted((each["values"], each["counts"]) for each in found))

    def successes(self, metric: str) -> FloatArray:
        """A metric of the counted successful missions that have it."""
        return known(self.metrics[metric][self.succeeded & self.counted])

    def matched(self, other: Group) -> tuple[IntArray, IntArray]:
        """Counted missions of equal pairs: row indices in this and in the other, (m,) each.

        The order is that of the other. Missions with faults match if the same faults strike them.
        If a pair was flown several times, the first flights match, then the second ones, and so on.
        One golden flight matches all.
        """
        there = np.flatnonzero(other.counted)
        here = partners(
            other.flights.take(there),
            self.flights,
            ("pair",) if self.golden else ("pair", "strike"),
            only=self.counted,
            repeats=not self.golden,
        )
        return here[here >= 0], there[here >= 0]


def untreated(labels: Mapping[str, Any]) -> str:
    """The labels that protected and unprotected flights with the same faults share, as text."""
    return canonical({name: value for name, value in labels.items() if name not in TREATMENT})


def groups(ledger: Ledger, by: Sequence[str] = ()) -> list[Group]:
    """The settings, merged by equal labels `by`; UnknownName if no setting has such a label."""
    labels = ledger.cells()
    names = {name for each in labels for name in each}
    for name in by:
        if name not in names:
            raise UnknownName("label", name, names)
    kept = [{name: each[name] for name in by or each if name in each} for each in labels]
    members: dict[str, list[int]] = {}
    for cell, each in enumerate(kept):
        members.setdefault(canonical(each), []).append(cell)
    planned, errors = ledger.planned_by_cell(), ledger.errors_by_cell()
    parts = _parts(_short_rows(ledger, labels), list(members.values()), len(labels))
    return [
        Group(
            labels=kept[those[0]],
            lacked=[name for name in by if name not in kept[those[0]]],
            planned=sum(planned[cell] for cell in those),
            errors=sum(errors.get(cell, 0) for cell in those),
            watched=all(labels[cell].get("detector") not in (None, "none") for cell in those),
            flights=part,
        )
        for those, part in zip(members.values(), parts, strict=True)
    ]


def _short_rows(ledger: Ledger, labels: Sequence[Mapping[str, Any]]) -> pa.Table:
    kinds = dict.fromkeys(_WHOLE, pa.int64()) | dict.fromkeys(_WORDS, pa.string())
    schema = pa.schema(kinds | dict.fromkeys(METRICS, pa.float64()))
    portions = [
        pa.table([pa.array(c, t) for c, t in zip(portion, schema.types, strict=True)], schema)
        for portion in ledger.columns(schema.names)
    ]
    whole = pa.concat_tables(portions or [schema.empty_table()]).combine_chunks()
    strikes: dict[str, int] = {}
    coded = [strikes.setdefault(untreated(each), len(strikes)) for each in labels]
    pairs = pc.dictionary_encode(whole["pair"]).combine_chunks()
    indices = pairs.indices if isinstance(pairs, pa.DictionaryArray) else pairs.chunk(0).indices
    return whole.set_column(whole.schema.get_field_index("pair"), "pair", indices).append_column(
        "strike", pa.array(np.array(coded, dtype=np.int64)[whole["cell"].to_numpy()])
    )


def _parts(whole: pa.Table, members: Sequence[Sequence[int]], cells: int) -> list[pa.Table]:
    """The rows of each group of cells, in the order of the list."""
    group_of = np.zeros(cells, dtype=np.int64)
    for index, those in enumerate(members):
        group_of[those] = index
    mine = group_of[whole["cell"].to_numpy()]
    ordered = whole.take(np.argsort(mine, kind="stable"))
    ends = np.searchsorted(np.sort(mine), np.arange(len(members)), side="right").tolist()
    begins = [0, *ends][:-1]
    return [ordered.slice(a, b - a) for a, b in zip(begins, ends, strict=True)]


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

    def worst(self) -> tuple[dict[str, float], dict[str, float]]:
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
        at_golden, at_faulty = self.golden.matched(self.first)
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
            found.append(_Match(golden, group, golden, *golden.matched(group)))
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
            found.append(_Match(faulty, group, golden, *faulty.matched(group)))
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
    tests = [McNemar.of(*each.success) for each in matches]
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
                "over_own": over_own,
                "over_mean": over_mean,
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
