"""Summary of a campaign: results of each setting, and comparisons between settings.

The flights of a user's companion are not repeatable, so they cannot be paired: settings with such
flights are compared as independent samples.

Only the short rows of the ledger are read, because a campaign may have a million missions.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import BoolArray, IntArray, known, numbers, untreated
from mavfi_cli.analysis.pairs import partners
from mavfi_cli.campaigns.ledger import REPEATS, STRATUM, WEIGHT, Ledger
from mavfi_cli.campaigns.missions import COUNTED, Injected, Labels, canonical, label_text
from mavfi_cli.core.errors import UnknownName
from mavfi_cli.core.types import FloatArray, Outcome
from mavfi_cli.stats.bootstrap import TABLE_RESAMPLES, interval
from mavfi_cli.stats.paired import OWN, McNemar, WorstCase, holm
from mavfi_cli.stats.shares import Interval, Share, design_effect, wilson
from mavfi_cli.stats.strata import weighted_share

METRICS = ("flight_time_s", "distance_m", "energy_regression_j", "replans")
INACTIVE = frozenset(kind.value for kind in Injected) - COUNTED
_WHOLE = ("cell", "number")
_WORDS = ("outcome", "injected", "pair", STRATUM)


# Results ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingSummary:
    """The results of one setting of a campaign: counts of missions, success rates and means.

    Attributes:
        name: the labels of the setting in one phrase.
        planned, errors: number of missions on the list, and of those that could not begin.
        outcomes, injected: number of flown missions by outcome, and by the fate of the fault.
        success: success rate over the counted missions: golden ones, and those whose fault struck,
            unless the struck value expired before anything read it.
        inactive: success rate over faults that were not injected or not activated.
        every: success rate over all flown missions, as in the paper.
        metrics: mean of each of the METRICS over the successful missions that `success` counts.
    """

    labels: Labels
    name: str
    planned: int
    errors: int
    outcomes: Mapping[str, int]
    injected: Mapping[str, int]
    success: Share
    inactive: Share
    every: Share
    metrics: Mapping[str, Interval]

    @property
    def faulty(self) -> bool:
        """Whether any flown mission of the setting has a fault."""
        return any(kind != Injected.GOLDEN.value for kind in self.injected)


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Comparison of two settings of a campaign over the missions that were flown in both.

    Attributes:
        first, second: labels of the reference and of the other setting.
        name: the labels of the other setting in one phrase.
        success: McNemar's test of success in the two settings.
        corrected_p: p-value of `success` after Holm's correction over all comparisons of this kind.
        differences: mean of second minus first for each of the METRICS, over the pairs in which
            both flights succeeded.
        over_own: largest ratio of a flight time to that of the golden flight of the same mission,
            if both succeeded.
        over_mean: ratio of the longest of these flights to the mean of their golden flights, as in
            the paper. If the second setting is protected, `over_own` and `over_mean` include what
            protection recovers.
    """

    first: Labels
    second: Labels
    name: str
    success: McNemar
    corrected_p: float
    differences: Mapping[str, Interval]
    over_own: WorstCase
    over_mean: WorstCase


@dataclass(frozen=True, slots=True, kw_only=True)
class UnpairedComparison:
    """Comparison of two settings of a user's companion, whose flights are not repeatable.

    Attributes:
        first, second: labels of the reference and of the other setting.
        name: the labels of the other setting in one phrase.
        first_success, second_success: success rate of each setting.
        difference: second success rate minus the first, with Newcombe's interval.
        p_value, corrected_p: p-value of Fisher's exact test, and the same after Holm's correction
            over all comparisons of this kind.
        differences: for each of the METRICS, the mean over the successful flights of the second
            setting minus that of the first, with Welch's interval.
        golden: success rate of the golden flights.
        golden_deviation: standard deviation of each of the METRICS over the successful golden
            flights; NaN if there are fewer than two.
    """

    first: Labels
    second: Labels
    name: str
    first_success: Share
    second_success: Share
    difference: Interval
    p_value: float
    corrected_p: float
    differences: Mapping[str, Interval]
    golden: Share
    golden_deviation: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """The distribution of one metric over the successful missions of one setting.

    Attributes:
        name: the labels of the setting in one phrase.
        least, median, most: smallest, median and largest value; NaN without successful missions.
        difference: mean difference from the golden flights of the same missions, or from all golden
            flights if flights are not repeatable; None for golden settings, for settings that have
            no golden flights to compare with, and for settings with flights of both kinds.
    """

    labels: Labels
    name: str
    metric: str
    mean: Interval
    least: float
    median: float
    most: float
    difference: Interval | None


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignSummary:
    """The results of a campaign: one row per setting, and comparisons between settings.

    Attributes:
        missions: number of missions on the list.
        over, missing: number of missions with a result, and without one.
        confidence: confidence level of all intervals.
        sampling: how faults were drawn, `uniform` or `stratified`.
        cells: the results of each setting.
        faults: each setting with faults compared with its golden setting.
        protection: each protected setting compared with the unprotected one with the same faults.
        unpaired_faults, unpaired_protection: the same for flights that are not repeatable.
    """

    name: str
    missions: int
    over: int
    confidence: float
    sampling: str
    cells: Sequence[SettingSummary]
    faults: Sequence[Comparison]
    protection: Sequence[Comparison]
    unpaired_faults: Sequence[UnpairedComparison]
    unpaired_protection: Sequence[UnpairedComparison]
    missing: int


# Groups of missions -------------------------------------------------------------------------------


@dataclass(frozen=True)  # no slots: cached properties need a dict
class Group:
    """The missions of one setting, or of several settings that are counted together.

    Attributes:
        labels: the labels that these missions share.
        lacked: labels by which missions are grouped and that these missions do not have.
        planned, errors: number of missions on the list, and of those that could not begin.
        watched: whether every one of these missions runs a detector.
        flights: a table of the flown missions, in the order of the list, with the columns `number`,
            `cell`, `outcome`, `injected`, METRICS, `stratum`, `weight`, `pair`, `strike` and
            `repeats`. Golden, faulty and protected flights of a mission share the code `pair`.
            Settings whose labels differ only in TREATMENT share the code `strike`, which stands for
            the fault. `repeats` is 0 for the flights of a user's companion.
    """

    labels: Labels
    lacked: Sequence[str]
    planned: int
    errors: int
    watched: bool
    flights: pa.Table

    @property
    def name(self) -> str:
        """A phrase made of the labels, and of the grouping labels that the missions do not have."""
        if not self.lacked or "setting" in self.labels:  # the setting's name is enough
            return label_text(self.labels)
        less = "golden" if self.flights.num_rows and self.golden else f"no {', '.join(self.lacked)}"
        return f"{label_text(self.labels)} {less}" if self.labels else less

    @cached_property
    def metrics(self) -> Mapping[str, FloatArray]:
        """The values of each of the METRICS, as an array of shape (n,) with NaN for nulls."""
        return {name: numbers(self.flights, name) for name in METRICS}

    @cached_property
    def succeeded(self) -> BoolArray:
        """Whether each mission reached its goal, as an array of shape (n,)."""
        return self.among("outcome", (Outcome.SUCCESS.value,))

    @cached_property
    def counted(self) -> BoolArray:
        """Whether each mission counts for the success rate, as an array of shape (n,).

        A mission counts if it is golden, or if its fault struck, unless the struck value expired
        before anything read it.
        """
        return self.among("injected", COUNTED)

    @cached_property
    def golden(self) -> bool:
        """Whether none of the missions has a fault."""
        return bool(self.among("injected", (Injected.GOLDEN.value,)).all())

    @cached_property
    def repeats(self) -> BoolArray:
        """Whether each flight is repeatable, as an array of shape (n,)."""
        return self.codes("repeats").astype(bool)

    @staticmethod
    def parts(groups: Iterable[Group], *, repeats: bool) -> list[Group]:
        """Return each group with only its repeatable flights, or with only its other flights.

        Groups that have no such flights are omitted.

        Args:
            repeats: True keeps the repeatable flights, False keeps the others.
        """
        chosen = [(group, group.repeats == repeats) for group in groups]
        return [
            group if own.all() else replace(group, flights=group.flights.filter(pa.array(own)))
            for group, own in chosen
            if own.any()
        ]

    @cached_property
    def pairs(self) -> IntArray:
        """The distinct codes `pair` of the counted missions, in ascending order."""
        return np.unique(self.codes("pair")[self.counted])

    def codes(self, name: str) -> IntArray:
        """Return an integer column of `flights` as an array of shape (n,)."""
        return np.asarray(self.flights[name].to_numpy(), dtype=np.int64)

    def among(self, name: str, words: Iterable[str]) -> BoolArray:
        """Return whether the text column of each mission equals one of `words`, with shape (n,)."""
        matches = pc.is_in(self.flights[name], value_set=pa.array(sorted(words), pa.string()))
        return np.asarray(matches.to_numpy(), dtype=bool)

    def counts(self, name: str) -> dict[str, int]:
        """Count the missions for each value of a text column. The values are in sorted order."""
        entries = pc.value_counts(self.flights[name]).to_pylist()
        return dict(sorted((entry["values"], entry["counts"]) for entry in entries))

    @cached_property
    def stratified(self) -> bool:
        """Whether some of the missions belong to a stratified sample."""
        return bool(self.flights[STRATUM].null_count < self.flights.num_rows)

    @cached_property
    def weights(self) -> FloatArray | None:
        """The weight of each mission, as an array of shape (n,), or None in a uniform sample."""
        return numbers(self.flights, WEIGHT) if self.stratified else None

    @cached_property
    def clusters(self) -> IntArray | None:
        """The cluster of each mission, as an array of shape (n,), or None if all are independent.

        A cluster is the faults of one pair in a uniform sample that has several faults per pair.
        They strike the same invocation of a node, so their effects are correlated.
        """
        places = np.column_stack([self.codes("cell"), self.codes("pair")])
        alone = self.golden or self.stratified or len(np.unique(places, axis=0)) == len(places)
        return None if alone else self.codes("pair")

    def share(self, hits: BoolArray, chosen: BoolArray, confidence: float = 0.95) -> Share:
        """Return the share of hits among the chosen missions, with its confidence interval.

        It takes weights and clusters of the missions into account.

        Args:
            hits, chosen: whether each mission is a hit, and whether it is chosen, of shape (n,).
        """
        if self.clusters is not None:
            own, places = hits[chosen].tolist(), self.clusters[chosen].tolist()
            effect = design_effect(own, [("", place) for place in places])
            return wilson(sum(own), len(own), design_effect=effect, confidence=confidence)
        weights = np.ones(len(hits)) if self.weights is None else self.weights
        return weighted_share(
            hits.tolist(),
            chosen.tolist(),
            weights.tolist(),
            self.flights[STRATUM].to_pylist(),
            confidence=confidence,
        )

    def success(self, confidence: float = 0.95) -> Share:
        """Return the success rate of the counted missions."""
        return self.share(self.succeeded, self.counted, confidence)

    def successes(self, metric: str) -> FloatArray:
        """Return the values of a metric, without nulls, for the counted missions that succeeded."""
        return known(self.metrics[metric][self.succeeded & self.counted])

    def mean(self, metric: str, confidence: float = 0.95) -> Interval:
        """Return the mean of a metric over the counted missions that succeeded, with its interval.

        It takes weights and clusters of the missions into account.
        """
        values = self.metrics[metric]
        there = self.succeeded & self.counted & ~np.isnan(values)
        weights = None if self.weights is None else self.weights[there]
        clusters = None if self.clusters is None else self.clusters[there]
        return _interval(values[there], confidence, weights, clusters)

    def deviation(self, metric: str) -> float:
        """Return the standard deviation of a metric over the counted missions that succeeded.

        The result is NaN if fewer than two of them have a value.
        """
        values = self.successes(metric)
        return float(np.std(values - values[0], ddof=1)) if len(values) > 1 else np.nan

    def golden_among(self, groups: Sequence[Group]) -> Group | None:
        """Return the golden group that shares the most pairs with this group, or None.

        Golden groups with a detector are ignored. None means that no golden group shares a pair, or
        that this group is itself golden.
        """
        if self.golden:
            return None
        shared = [
            (np.intersect1d(self.pairs, other.pairs, assume_unique=True).size, -index)
            for index, other in enumerate(groups)
            if other.golden and not other.watched
        ]
        most = max(shared, default=(0, 0))
        return groups[-most[1]] if most[0] else None

    def matched(self, other: Group) -> tuple[IntArray, IntArray]:
        """Return the row indices of matching missions, in this group and in the other group.

        Both arrays have the shape (m,) and the order of the other group. Only counted missions
        match. Missions of a pair match if this group is golden, or if they have the same fault. If
        a pair was flown several times, the first flights match, then the second ones, and so on. A
        golden flight matches every flight of its pair.
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


def groups(ledger: Ledger, by: Sequence[str] = ()) -> list[Group]:
    """Group the missions of a campaign by labels, one group per combination of label values.

    Args:
        by: names of the labels; empty groups by all labels, which gives one group per setting.

    Raises:
        UnknownName: no setting has a label with one of these names.
    """
    labels = ledger.cells()
    names = {name for setting in labels for name in setting}
    for name in by:
        if name not in names:
            raise UnknownName("label", name, names)
    kept = [
        {name: setting[name] for name in by or setting if name in setting} for setting in labels
    ]
    members: dict[str, list[int]] = {}
    for cell, setting in enumerate(kept):
        members.setdefault(canonical(setting), []).append(cell)
    planned, errors = ledger.planned_by_cell(), ledger.errors_by_cell()
    parts = _split(_short_rows(ledger, labels), list(members.values()), len(labels))
    return [
        Group(
            labels=kept[cells[0]],
            lacked=[name for name in by if name not in kept[cells[0]]],
            planned=sum(planned[cell] for cell in cells),
            errors=sum(errors.get(cell, 0) for cell in cells),
            watched=all(labels[cell].get("detector") not in (None, "none") for cell in cells),
            flights=part,
        )
        for cells, part in zip(members.values(), parts, strict=True)
    ]


def _short_rows(ledger: Ledger, labels: Sequence[Labels]) -> pa.Table:
    kinds = dict.fromkeys(_WHOLE, pa.int64()) | dict.fromkeys(_WORDS, pa.string())
    kinds |= {"changes": pa.string()} if ledger.stratified else {}
    kinds |= dict.fromkeys((*METRICS, WEIGHT), pa.float64()) | {"repeats": pa.int64()}
    schema = pa.schema(kinds)
    portions = [
        pa.table([pa.array(c, t) for c, t in zip(portion, schema.types, strict=True)], schema)
        for portion in ledger.columns([*schema.names[:-1], REPEATS])
    ]
    whole = pa.concat_tables(portions or [schema.empty_table()]).combine_chunks()
    strikes: dict[str, int] = {}
    coded = [strikes.setdefault(untreated(setting), len(strikes)) for setting in labels]
    strike = np.array(coded, dtype=np.int64)[whole["cell"].to_numpy()]
    if ledger.stratified:  # several faults strike one pair
        faults = map(_fault_text, whole["changes"].to_pylist())
        names = [f"{code} {fault}" for code, fault in zip(strike, faults, strict=True)]
        strike = np.array([strikes.setdefault(name, len(strikes)) for name in names], np.int64)
    pairs = pc.dictionary_encode(whole["pair"]).combine_chunks()
    indices = pairs.indices if isinstance(pairs, pa.DictionaryArray) else pairs.chunk(0).indices
    return whole.set_column(whole.schema.get_field_index("pair"), "pair", indices).append_column(
        "strike", pa.array(strike)
    )


def _fault_text(changes: str) -> str:
    config = json.loads(changes)
    return canonical([config.get("fault"), config.get("instruction")])


def _split(whole: pa.Table, members: Sequence[Sequence[int]], cells: int) -> list[pa.Table]:
    """Split the rows of a table into one table per group of settings, keeping their order.

    Args:
        members: numbers of the settings (`cell`) of each group.
        cells: number of all settings.
    """
    group_of = np.zeros(cells, dtype=np.int64)
    for index, cells_of_group in enumerate(members):
        group_of[cells_of_group] = index
    mine = group_of[whole["cell"].to_numpy()]
    ordered = whole.take(np.argsort(mine, kind="stable"))
    ends = np.searchsorted(np.sort(mine), np.arange(len(members)), side="right").tolist()
    begins = [0, *ends][:-1]
    return [ordered.slice(a, b - a) for a, b in zip(begins, ends, strict=True)]


@dataclass(frozen=True, slots=True)
class _Arms:
    """Two settings to compare, and the golden setting that both refer to."""

    first: Group
    second: Group
    golden: Group


@dataclass(frozen=True, slots=True)
class _Match(_Arms):
    """Two settings to compare, with their m pairs of matching flights.

    `at_first` and `at_second` hold the row indices of the pairs in each setting, of shape (m,).
    """

    at_first: IntArray
    at_second: IntArray

    @property
    def success(self) -> tuple[BoolArray, BoolArray]:
        """Whether the first and whether the second flight of each pair succeeded, (m,) each."""
        return self.first.succeeded[self.at_first], self.second.succeeded[self.at_second]

    @property
    def clusters(self) -> IntArray | None:
        """The cluster of each pair, of shape (m,), or None if all are independent; see `Group`."""
        return None if self.second.clusters is None else self.second.clusters[self.at_second]

    @property
    def weights(self) -> FloatArray | None:
        """The weight of the fault of each pair, of shape (m,), or None in a uniform sample."""
        return None if self.second.weights is None else self.second.weights[self.at_second]

    def difference(self, metric: str, confidence: float) -> Interval:
        """Return the mean of second minus first of a metric, with its confidence interval.

        It covers the pairs in which both flights succeeded and have the metric.
        """
        first, second = self.success
        change = self.second.metrics[metric][self.at_second]
        change = change - self.first.metrics[metric][self.at_first]
        there = first & second & ~np.isnan(change)
        weights = None if self.weights is None else self.weights[there]
        clusters = None if self.clusters is None else self.clusters[there]
        return _interval(change[there], confidence, weights, clusters)

    def worst(self) -> tuple[WorstCase, WorstCase]:
        """Return the worst flight times, in two ways, over the pairs whose golden flight succeeded.

        The first worst case is relative to the golden flight of each pair. The second is relative
        to the mean of these golden flights.
        """
        if self.first.golden:
            golden, sides = self.at_first, [(self.second, self.at_second)]
        else:
            golden = self._golden_of_first()
            sides = [(self.first, self.at_first), (self.second, self.at_second)]
        reference = self._times(self.golden, golden)
        times = [self._times(group, places) for group, places in sides]
        usable = [~np.isnan(reference) & ~np.isnan(times_s) for times_s in times]
        used = np.logical_or.reduce(usable)
        _, once = np.unique(golden[used], return_index=True)
        golden_s = reference[used][once]
        pairs = list(zip(times, usable, strict=True))
        return (
            WorstCase.of(
                OWN, *((times_s[both] / reference[both]).tolist() for times_s, both in pairs)
            ),
            WorstCase.of(golden_s.tolist(), *(times_s[both].tolist() for times_s, both in pairs)),
        )

    def _golden_of_first(self) -> IntArray:
        """Return the row index of each pair's golden flight, of shape (m,), or -1 without one."""
        own = np.full(self.first.flights.num_rows, -1)
        at_golden, at_faulty = self.golden.matched(self.first)
        own[at_faulty] = at_golden
        return own[self.at_first]

    @staticmethod
    def _times(group: Group, places: IntArray) -> FloatArray:
        """Return the flight time at each row index, or NaN if the flight failed or the index is -1.

        The indices and the times have the shape (m,).
        """
        times_s = np.full(len(places), np.nan)
        there = (places >= 0) & group.succeeded[places]
        times_s[there] = group.metrics["flight_time_s"][places[there]]
        return times_s


def _against_golden(groups: Sequence[Group]) -> list[_Arms]:
    """Match each setting that has faults to the golden setting that shares the most pairs."""
    goldens = [(group, group.golden_among(groups)) for group in groups]
    return [_Arms(golden, group, golden) for group, golden in goldens if golden is not None]


def _protection(groups: Sequence[Group]) -> list[_Arms]:
    """Match each protected setting to the unprotected one that has the same faults."""
    bare = {
        untreated(group.labels): group for group in groups if not (group.watched or group.golden)
    }
    compared = []
    for group in groups:
        if not group.watched:
            continue
        faulty, golden = bare.get(untreated(group.labels)), group.golden_among(groups)
        if faulty is not None and golden is not None:
            compared.append(_Arms(faulty, group, golden))
    return compared


def _paired(arms: Sequence[_Arms], confidence: float) -> list[Comparison]:
    """Compare the two settings in each of `arms` over the missions that were flown in both."""
    matches = [
        _Match(own.first, own.second, own.golden, *own.first.matched(own.second)) for own in arms
    ]
    matches = [match for match in matches if len(match.at_second)]
    tests = [
        McNemar.of(*match.success, weights=match.weights, clusters=match.clusters)
        for match in matches
    ]
    corrected = holm([test.p_value for test in tests])
    rows = []
    for match, test, p_value in zip(matches, tests, corrected, strict=True):
        over_own, over_mean = match.worst()
        rows.append(
            Comparison(
                first=match.first.labels,
                second=match.second.labels,
                name=match.second.name,
                success=test,
                corrected_p=p_value,
                differences={name: match.difference(name, confidence) for name in METRICS},
                over_own=over_own,
                over_mean=over_mean,
            )
        )
    return rows


def _unpaired(arms: Sequence[_Arms], confidence: float) -> list[UnpairedComparison]:
    """Compare the two settings in each of `arms` as independent samples."""
    arms = [own for own in arms if own.first.counted.any() and own.second.counted.any()]
    shares = [(own.first.success(confidence), own.second.success(confidence)) for own in arms]
    p_values = [first.fisher(second) for first, second in shares]
    return [
        UnpairedComparison(
            first=own.first.labels,
            second=own.second.labels,
            name=own.second.name,
            first_success=first,
            second_success=second,
            difference=second.minus(first),
            p_value=p_value,
            corrected_p=corrected,
            differences={
                name: Interval.welch(
                    own.first.successes(name), own.second.successes(name), confidence
                )
                for name in METRICS
            },
            golden=own.golden.success(confidence),
            golden_deviation={name: own.golden.deviation(name) for name in METRICS},
        )
        for own, (first, second), p_value, corrected in zip(
            arms, shares, p_values, holm(p_values), strict=True
        )
    ]


def _interval(
    values: FloatArray,
    confidence: float,
    weights: FloatArray | None,
    clusters: IntArray | None,
) -> Interval:
    """Return the mean of the values with its confidence interval.

    With clusters, both are computed from the means of the clusters, because only these are
    independent of each other.
    """
    if clusters is not None and len(values):
        _, which = np.unique(clusters, return_inverse=True)
        values = np.bincount(which, values) / np.bincount(which)
    return interval(values, confidence=confidence, resamples=TABLE_RESAMPLES, weights=weights)


def summarise(
    ledger: Ledger, settings: Sequence[Group], confidence: float = 0.95
) -> CampaignSummary:
    """Summarise the flown missions of a campaign: results by setting, and comparisons.

    Args:
        settings: the groups of missions to summarise, as `groups` returns them.
        confidence: confidence level of all intervals.
    """
    missions, over = ledger.planned(), ledger.over()
    pairs, apart = (Group.parts(settings, repeats=repeats) for repeats in (True, False))
    return CampaignSummary(
        name=ledger.meta("name") or ledger.folder.name,
        missions=missions,
        over=over,
        confidence=confidence,
        sampling=ledger.sampling.value,
        cells=[_setting(group, confidence) for group in settings],
        faults=_paired(_against_golden(pairs), confidence),
        protection=_paired(_protection(pairs), confidence),
        unpaired_faults=_unpaired(_against_golden(apart), confidence),
        unpaired_protection=_unpaired(_protection(apart), confidence),
        missing=missions - over,
    )


def _setting(group: Group, confidence: float) -> SettingSummary:
    def success(fates: frozenset[str]) -> Share:
        return group.share(group.succeeded, group.among("injected", fates), confidence)

    return SettingSummary(
        labels=group.labels,
        name=group.name,
        planned=group.planned,
        errors=group.errors,
        outcomes=group.counts("outcome"),
        injected=group.counts("injected"),
        success=group.success(confidence),
        inactive=success(INACTIVE),
        every=success(COUNTED | INACTIVE),
        metrics={name: group.mean(name, confidence) for name in METRICS},
    )


def qualities(groups: Sequence[Group], confidence: float = 0.95) -> list[Quality]:
    """Summarise each metric over the successful missions of each setting.

    The result has one row per metric and setting, metric by metric.
    """
    pairs, apart = (
        {
            row.name: row.differences
            for row in compare(_against_golden(Group.parts(groups, repeats=repeats)), confidence)
        }
        for repeats, compare in ((True, _paired), (False, _unpaired))
    )
    golden = {name: (pairs | apart)[name] for name in pairs.keys() ^ apart.keys()}
    rows = []
    for metric in METRICS:
        for group in groups:
            values = group.successes(metric)
            ends = np.quantile(values, (0.0, 0.5, 1.0)) if len(values) else np.full(3, np.nan)
            least, middle, most = ends.tolist()
            rows.append(
                Quality(
                    labels=group.labels,
                    name=group.name,
                    metric=metric,
                    mean=group.mean(metric, confidence),
                    least=least,
                    median=middle,
                    most=most,
                    difference=golden.get(group.name, {}).get(metric),
                )
            )
    return rows
