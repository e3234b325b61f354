"""Evaluate detectors on flights with and without faults.

A pair holds the flights of one mission: golden, faulty, and faulty with a detector. Results are
counts of pairs, most of them with a confidence interval. Faults that were not injected or not read
are counted separately; the only other number that they enter is `detected_inactive`. Faults in
missions whose golden flight fails are counted separately too, because they can do no harm. All
harmful faults are repeated with every detector, harmless ones only in `complete` missions. The
effect of a fault is taken from the unprotected flight, because a detector may withhold the value
before it is read.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import IntArray, chosen, flags, known, numbers
from mavfi_cli.analysis.pairs import LONGER, against_golden, paired, partners
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.core.types import FloatArray
from mavfi_cli.link.session import SessionSettings
from mavfi_cli.stats.bootstrap import interval, interval_of_rows, median
from mavfi_cli.stats.paired import OWN, McNemar, WorstCase, holm
from mavfi_cli.stats.roc import Curves
from mavfi_cli.stats.shares import Interval, Share, mixture, wilson

NONE = "none"  # no detector: the reference for all others
ERROR_FREE, FAULT = "error-free", "fault"  # kinds of missions
KEY = ("world", "seed", "level", "stage", "target", "field")  # golden flights have the first two
# Columns used to form pairs, in addition to the labels: KEY, kind and detector.
WANTED = (
    "outcome", "succeeded", "flight_time_s", "injected", "struck_s", "struck_sites", "first_bits",
    "crashed", "alarms", "alarm_count", "episodes", "path",
)  # fmt: skip
_TEXT, _NUMBER, _FLAG, _COUNT = pa.string(), pa.float64(), pa.bool_(), pa.int64()
CSV = {
    "kind": _TEXT, "world": _TEXT, "seed": _COUNT, "detector": _TEXT, "level": _TEXT,
    "stage": _TEXT, "target": _TEXT, "field": _TEXT, "state": _TEXT, "bits": _TEXT,
    "injected": _TEXT, "harm": _TEXT, "crashed": _FLAG, "golden_outcome": _TEXT,
    "golden_time_s": _NUMBER, "faulty_outcome": _TEXT, "faulty_time_s": _NUMBER, "outcome": _TEXT,
    "time_s": _NUMBER, "lengthening": _NUMBER, "struck_s": _NUMBER, "alarm_s": _NUMBER,
    "alarm_stage": _TEXT, "latency_s": _NUMBER, "by_chance": _FLAG, "remaining_harm": _TEXT,
    "alarms": _COUNT, "episodes": _COUNT,
}  # fmt: skip
SCHEMA = pa.schema(
    CSV | dict.fromkeys(("golden_won", "faulty_won", "won", "active", "judged", "struck", "seen",
                         "undone", "complete"), _FLAG)
    | {"faulty_lengthening": _NUMBER, "faulty_struck_s": _NUMBER, "golden_path": _TEXT,
       "faulty_path": _TEXT}
)  # fmt: skip
# A single flight, with the column names that SCHEMA uses for it.
_FLOWN = pa.schema(
    [(name, CSV[name]) for name in ("kind", "detector", *KEY, "injected", "state", "bits",
                                    "crashed", "outcome", "time_s", "struck_s", "alarms",
                                    "episodes")]
    + [("won", _FLAG), ("path", _TEXT)]
)  # fmt: skip
# Effects of a fault on an unprotected flight, compared with its golden flight.
HARMLESS = "none"
LOST = "lost"  # the flight does not reach the goal
LATE = "longer"  # both reach the goal, but the flight takes more than LONGER times as long
RESAMPLES = 999
TICKS_PER_S = SessionSettings().state_rate_hz  # one control tick per state message
ALL = "all"
GROUPS = (ALL, "world", "stage", "field", "state")  # labels by which faults are grouped
_NOTHING_SEEN = -math.log(0.025)  # upper 95 % limit of a Poisson count that was 0
# Maps a detector to its harmful faults with their scores, and to its scores of error-free flights.
Scored = Callable[[str], tuple[pa.Table, list[float]]]


# Results ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorFreeRow:
    """Results of a detector on a group of error-free flights, compared with those without it.

    Attributes:
        by, value: label by which the flights are grouped, and its value in this group.
        hours: total flight time with the detector, in hours from take-over to the end of each
            mission.
        alarms, episodes: number of alarms, and of runs of consecutive alarms.
        alarms_per_hour: alarms per flight hour. The interval is bootstrapped over flights or, if no
            flight has an alarm, comes from the Poisson distribution.
        with_alarm: share of flights with at least one alarm.
        lost: share of golden successes that fail with the detector.
        gained: number of golden failures that succeed with the detector.
        success: number of pairs by success of the golden flight (first) and of the flight with the
            detector (second).
        lengthening: median of flight time / golden flight time - 1, over the pairs in which both
            flights succeed.
    """

    by: str
    value: str
    detector: str
    flights: int
    hours: float
    alarms: int
    episodes: int
    alarms_per_hour: Interval
    with_alarm: Share
    lost: Share
    gained: int
    success: McNemar
    lengthening: Interval


@dataclass(frozen=True, slots=True, kw_only=True)
class _WorstFlight:
    """The largest relative increase of flight time, and how much of it the detector recovers.

    The definition follows section VII-A of the paper, which uses one world with one seed. Here
    every mission has its own seed, so every successful flight is compared with its own golden
    flight.

    Attributes:
        faulty, protected: largest value of (flight time / golden flight time - 1), without and with
            the detector.
        recovered: `faulty` minus `protected`, each at least 0. A resample never contains a worse
            flight than the worst observed one, so the interval shows how much the value depends on
            single flights, not how bad the worst case can become.
        recovered_share: share of the increase `faulty` that the detector recovers; NaN if no
            unprotected flight took more than LONGER times as long as its golden flight.
    """

    faulty: float
    protected: float
    recovered: Interval
    recovered_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultRow:
    """Results of a detector on a group of flights with faults.

    Shares cover only active faults, except `detected_inactive`.

    Attributes:
        by, value: label by which the faults are grouped, and its value in this group.
        planned: number of faults, divided into `not_injected`, `not_activated` (never read),
            `golden_failed` (the mission fails even without the fault) and `active`.
        crashed: number of faults that killed a node. This is noticed even without a detector.
        harmful: share of faults that harm the unprotected flight: those in `lost` and `longer`.
        lost: number of faults with which the unprotected flight does not reach the goal.
        longer: number of faults with which it reaches the goal, but takes more than LONGER times as
            long as its golden flight.
        flown: number of faults repeated with this detector: all harmful ones, and the harmless
            ones of complete missions.
        not_struck: number of faults in `flown` that never struck because the protected flight had
            diverged. No detection rate includes them.
        latency_s, latency_s_p95: median and 95th percentile of the time from the strike of a
            harmful fault to the alarm.
        latency_ticks, latency_ticks_p95: the same times in control ticks.
        detected_harmful: share of harmful faults with an alarm at or after the strike.
        detected_active: the same for all faults of complete missions.
        detected_inactive: the same for faults of complete missions that struck but were not
            activated.
        by_chance: share of the faults of complete missions for which, even in the flight without
            the fault, the detector raises an alarm at or after the time of the strike.
        recovered: share of lost missions that succeed with the detector.
        undone: share of harmful faults that do no harm with the detector.
        added: share of harmless faults that do harm with the detector.
        unprotected: success rate of all missions with an active fault, without the detector.
        protected: the same with the detector, as `share`, `low` and `high`: the rates for harmful
            and for harmless faults, weighted by the numbers of these faults.
        success: number of pairs in complete missions by success of the unprotected flight (first)
            and of the flight with the detector (second).
        worst: the worst case over the faults in `flown`.
    """

    by: str
    value: str
    detector: str
    planned: int
    not_injected: int
    not_activated: int
    golden_failed: int
    active: int
    crashed: int
    harmful: Share
    lost: int
    longer: int
    flown: int
    not_struck: int
    latency_s: Interval
    latency_s_p95: Interval
    latency_ticks: float
    latency_ticks_p95: float
    detected_harmful: Share
    detected_active: Share
    detected_inactive: Share
    by_chance: Share
    recovered: Share
    undone: Share
    added: Share
    unprotected: Share
    protected: dict[str, float]
    success: McNemar
    worst: _WorstFlight


@dataclass(frozen=True, slots=True, kw_only=True)
class _CorrectedTest(McNemar):
    """McNemar's test of two detectors on the same faults, with a corrected p-value.

    Attributes:
        corrected_p: `p_value` after Holm's correction over all comparisons of the same kind.
    """

    corrected_p: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorComparison:
    """A comparison of two detectors on the same harmful faults.

    Attributes:
        recovered: test of how many lost missions succeed with each detector.
        undone: test of how many harmful faults do no harm with each detector.
    """

    first: str
    second: str
    recovered: _CorrectedTest
    undone: _CorrectedTest


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorCurves(Curves):
    """The curves of a detector over all harmful faults, and areas for groups of these faults.

    Attributes:
        areas: one entry per stage and per bit field of the faults, with the numbers `area`,
            `area_low`, `area_high`, `average_precision` and `positives` of the group.
    """

    areas: list[dict[str, str | float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluatedPlan:
    """The plan of an evaluation, as stored in `evaluation.json`.

    Attributes:
        detectors: threshold and model digest of each detector, keyed by its name.
        protect: stages that the detectors watch.
        places: stage, target and bit field of each kind of fault.
        mission: parameters of all missions that differ from the defaults.
        seed: seed of the faults.
    """

    worlds: tuple[str, ...]
    detectors: dict[str, dict[str, float | str]]
    protect: tuple[str, ...]
    places: list[dict[str, str]]
    mission: dict[str, Any]
    level: str
    flights: int
    harmless_flights: int
    golden_flights: int
    first_seed: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The contents of `evaluation.json`: the plan and the results of an evaluation of detectors.

    Attributes:
        error_free, faults: one row per group and detector, for flights without and with a fault.
        comparisons: one entry for every two detectors.
        curves: the curves of each detector, keyed by its name.
        errors: labels and reason of each mission that could not begin.
    """

    error_free: list[ErrorFreeRow]
    faults: list[FaultRow]
    comparisons: list[DetectorComparison]
    curves: dict[str, DetectorCurves]
    schema: int
    plan: EvaluatedPlan
    versions: dict[str, str]
    errors: list[str]


# Pairs --------------------------------------------------------------------------------------------


def pairs_of(
    flights: Iterable[pa.Table], detectors: Collection[str], complete: Callable[[int], bool]
) -> tuple[pa.Table, pa.Table]:
    """Match flights into pairs, and return those without a fault and those with one as two tables.

    Args:
        flights: ended flights with labels for kind, detector and KEY, in the order of the pairs.
        detectors: detectors of the pairs to return.
        complete: returns whether all faults of the mission with a given seed are repeated with
            detectors.

    Returns:
        Two tables with the columns of SCHEMA. `active`: the unprotected flight was struck, and a
        node read the value or may have read it. `judged`: the fault is active, and the golden
        flight succeeds. `struck`: the protected flight was struck too; otherwise there was nothing
        to detect. `seen`: the protected flight had an alarm at or after the strike. `by_chance`:
        the detector raises an alarm at or after that time even without the fault.
    """
    rows = [row for table in flights for row in _rows_of(table)]
    alarms = [row.pop("all_alarms") for row in rows]
    table = pa.Table.from_pylist(rows, _FLOWN)
    free = np.asarray(pc.equal(table["kind"], ERROR_FREE))
    bare = np.asarray(pc.equal(table["detector"], NONE))
    golden = partners(table, table, ("world", "seed"), only=free & bare)
    watched = partners(table, table, ("world", "seed", "detector"), only=free)
    faulty = partners(table, table, ("kind", *KEY), only=bare)
    wanted = np.asarray(pc.is_in(table["detector"], pa.array([*detectors], _TEXT)))
    wanted &= golden >= 0
    whole = np.flatnonzero(wanted & free)
    treated = np.flatnonzero(wanted & ~free & (watched >= 0) & (faulty >= 0))
    struck_s = table["struck_s"].to_pylist()
    caught = [_first_alarm(alarms[place], struck_s[place]) for place in treated]
    chance = [_first_alarm(alarms[watched[place]], struck_s[place]) for place in treated]
    own, bare_own = table.take(treated), table.take(faulty[treated])
    active = pc.is_in(
        bare_own["injected"], pa.array([Injected.ACTIVE.value, Injected.UNREAD.value])
    )
    pairs = _against(table.take(golden[treated]), own)
    unprotected = _against(table.take(golden[treated]), bare_own)
    judged = pc.and_(active, pairs["golden_won"])
    latency_s = [alarm and max(0.0, alarm[0] - struck_s[place])
                 for alarm, place in zip(caught, treated, strict=True)]  # fmt: skip
    faults = pairs | {
        "state": pc.coalesce(bare_own["state"], own["target"]),
        "bits": bare_own["bits"],
        "injected": bare_own["injected"],
        "crashed": bare_own["crashed"],
        "harm": pc.if_else(judged, unprotected["harm"], ""),
        "remaining_harm": pc.if_else(judged, pairs["harm"], ""),
        "faulty_outcome": bare_own["outcome"],
        "faulty_time_s": bare_own["time_s"],
        "faulty_won": bare_own["won"],
        "faulty_lengthening": unprotected["lengthening"],
        "faulty_struck_s": bare_own["struck_s"],
        "faulty_path": bare_own["path"],
        "alarm_s": [alarm and alarm[0] for alarm in caught],
        "alarm_stage": [alarm and alarm[1] for alarm in caught],
        "latency_s": latency_s,
        "seen": [alarm is not None for alarm in caught],
        "by_chance": [alarm is not None for alarm in chance],
        "active": active,
        "judged": judged,
        "struck": pc.is_valid(own["struck_s"]),
        "undone": pc.equal(pairs["harm"], HARMLESS),
        "complete": [complete(seed) for seed in own["seed"].to_pylist()],
    }
    error_free = _against(table.take(golden[whole]), table.take(whole))
    error_free |= dict.fromkeys(("harm", "injected", "state", "bits", "crashed"))
    return _table_of(error_free, len(whole)), _table_of(faults, len(treated))


def _rows_of(table: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield each flight as a row with the columns of _FLOWN.

    The additional entry `all_alarms` lists the time and stage of each alarm.
    """
    labels = [name for name in ("kind", "detector", *KEY) if f"label_{name}" in table.column_names]
    for row in table.select([*(f"label_{name}" for name in labels), *WANTED]).to_pylist():
        yield {
            **{name: row[f"label_{name}"] for name in labels},
            **{name: row[name] for name in ("injected", "crashed", "outcome", "struck_s",
                                            "episodes", "path")},
            "state": "+".join(row["struck_sites"]) or None,
            "bits": " ".join(map(str, row["first_bits"])),
            "time_s": row["flight_time_s"],
            "won": row["succeeded"],
            "alarms": row["alarm_count"] or 0,
            "all_alarms": [(alarm["stamp_s"], alarm["stage"]) for alarm in row["alarms"]],
        }  # fmt: skip


def _first_alarm(
    alarms: Iterable[tuple[float, str]], from_s: float | None
) -> tuple[float, str] | None:
    """Return the first alarm at or after `from_s`, or None if there is none or `from_s` is None."""
    if from_s is None:
        return None
    return next((alarm for alarm in alarms if alarm[0] >= from_s - 1e-9), None)


def _against(golden: pa.Table, flown: pa.Table) -> dict[str, Any]:
    """Return columns that compare each flight in `flown` with the same row of `golden`.

    They are the columns of SCHEMA that `flown` has, those about the golden flight, `lengthening`
    and `harm`.
    """
    lost = pc.invert(flown["won"])
    over, harmed = against_golden(pc.invert(golden["won"]), golden["time_s"], lost, flown["time_s"])
    harm = pc.if_else(harmed, pc.if_else(lost, LOST, LATE), HARMLESS)
    return {
        **{name: flown[name] for name in flown.column_names if name in SCHEMA.names},
        "golden_outcome": golden["outcome"],
        "golden_time_s": golden["time_s"],
        "golden_won": golden["won"],
        "golden_path": golden["path"],
        "lengthening": pc.subtract(over, 1.0),
        "harm": harm,
    }


def _table_of(columns: dict[str, Any], rows: int) -> pa.Table:
    """Return a table with the schema SCHEMA. Columns that are missing or None hold only nulls."""
    arrays = []
    for field in SCHEMA:
        values = columns.get(field.name)
        if values is None:
            arrays.append(pa.nulls(rows, field.type))
        else:
            arrays.append(pa.array(values, field.type) if isinstance(values, list)
                          else values.cast(field.type))  # fmt: skip
    return pa.table(arrays, SCHEMA)


def harmful(faults: pa.Table) -> pa.Table:
    """Return the pairs without a detector whose fault did harm."""
    return chosen(faults, detector=NONE, harm=(LOST, LATE))


# Results of groups --------------------------------------------------------------------------------


def results(
    detectors: Sequence[str],
    error_free: pa.Table,
    faults: pa.Table,
    scored: Scored,
    **about: Any,
) -> Evaluation:
    """Compute the results of all detectors from the pairs of flights.

    Args:
        detectors: names of all detectors, `none` first.
        error_free, faults: the tables of pairs that `pairs_of` returns.
        scored: takes the name of a detector. Returns its harmful faults, with the columns `stage`,
            `field` and `score`, and its scores of the error-free flights.
        about: the other fields of the evaluation.
    """
    return Evaluation(
        **about,
        error_free=[
            _error_free_row(by, value, detector, part)
            for by, value, detector, part in _grouped(detectors, error_free, (ALL, "world"))
        ],
        faults=[
            _fault_row(by, value, detector, _part(faults, by, value, NONE), part)
            for by, value, detector, part in _grouped(detectors, faults, GROUPS)
        ],
        comparisons=_comparisons(detectors, faults),
        curves={name: _curves(*scored(name)) for name in detectors if name != NONE},
    )


def _grouped(
    detectors: Sequence[str], pairs: pa.Table, groups: Sequence[str]
) -> Iterator[tuple[str, str, str, pa.Table]]:
    """Yield, for each group of pairs, the label, its value, the detector and the table of pairs.

    The values of a label come in the order in which they first occur.
    """
    for by in groups:
        values = pc.unique(pairs[by]).to_pylist() if by != ALL else [ALL] * bool(pairs.num_rows)
        for value, detector in itertools.product(values, detectors):
            yield by, value, detector, _part(pairs, by, value, detector)


def _part(pairs: pa.Table, by: str, value: str, detector: str) -> pa.Table:
    return chosen(pairs, detector=detector, **({} if by == ALL else {by: value}))


def _comparisons(detectors: Sequence[str], faults: pa.Table) -> list[DetectorComparison]:
    """Compare every two detectors on the same faults, with p-values corrected by Holm."""
    names = [*itertools.combinations(detectors, 2)]
    tests = [_recoveries(*(chosen(faults, detector=name) for name in two)) for two in names]
    recovered, undone = (
        [
            _CorrectedTest(**asdict(test), corrected_p=corrected)
            for test, corrected in zip(kind, holm([test.p_value for test in kind]), strict=True)
        ]
        for kind in ([own[0] for own in tests], [own[1] for own in tests])
    )
    return [
        DetectorComparison(first=two[0], second=two[1], recovered=saved, undone=undid)
        for two, saved, undid in zip(names, recovered, undone, strict=True)
    ]


def _recoveries(first: pa.Table, second: pa.Table) -> tuple[McNemar, McNemar]:
    """Test which of two detectors recovers more lost missions, and which undoes more harm.

    Both tests use the same harmful faults for both detectors.
    """
    here, there = paired(chosen(first, harm=(LOST, LATE)), second, KEY)
    lost = pc.equal(here["harm"], LOST)
    return (
        McNemar.of(*(flags(table.filter(lost), "won") for table in (here, there))),
        McNemar.of(*(flags(table, "undone") for table in (here, there))),
    )


def _curves(scores: pa.Table, error_free: Sequence[float]) -> DetectorCurves:
    names = ("positives", "area", "area_low", "area_high", "average_precision")
    areas = []
    for by in ("stage", "field"):
        for value in pc.unique(scores[by]).to_pylist():
            part = Curves.of(chosen(scores, **{by: value})["score"].to_pylist(), error_free)
            numbers_of = {name: getattr(part, name) for name in names}
            areas.append({"by": by, "value": value, **numbers_of})
    return DetectorCurves.of(scores["score"].to_pylist(), error_free, areas=areas)


def _error_free_row(by: str, value: str, detector: str, pairs: pa.Table) -> ErrorFreeRow:
    alarms = numbers(pairs, "alarms")
    hours = np.nan_to_num(numbers(pairs, "time_s")) / 3600.0
    test = _ends(pairs, "golden_won")
    return ErrorFreeRow(
        by=by,
        value=value,
        detector=detector,
        flights=pairs.num_rows,
        hours=math.fsum(hours.tolist()),
        alarms=int(alarms.sum()),
        episodes=int(numbers(pairs, "episodes").sum()),
        alarms_per_hour=_rate_per_hour(alarms, hours),
        with_alarm=wilson(int(np.count_nonzero(alarms)), pairs.num_rows),
        lost=wilson(test.only_first, test.both + test.only_first),
        gained=test.only_second,
        success=test,
        lengthening=_interval(known(numbers(pairs, "lengthening")), median),
    )


def _rate_per_hour(alarms: FloatArray, hours: FloatArray) -> Interval:
    """Return the alarms per flight hour. Missions that were cut off without a time are omitted."""
    alarms, hours = alarms[hours > 0.0], hours[hours > 0.0]
    total = float(hours.sum())
    if total > 0.0 and not alarms.any():
        return Interval(value=0.0, low=0.0, high=_NOTHING_SEEN / total, count=len(alarms))
    return interval_of_rows(
        len(alarms),
        lambda rows: alarms[rows].sum(axis=-1) / hours[rows].sum(axis=-1),
        resamples=RESAMPLES,
    )


def _fault_row(by: str, value: str, detector: str, bare: pa.Table, pairs: pa.Table) -> FaultRow:
    """Compute the results of a detector on a group of faults.

    Args:
        bare: pairs of the group without a detector.
        pairs: pairs of the group with the detector.
    """
    injected = bare.filter(pc.not_equal(bare["injected"], Injected.NOT_INJECTED.value))
    active, judged = chosen(injected, active=True), chosen(injected, judged=True)
    counts = {harm: chosen(judged, harm=harm).num_rows for harm in (HARMLESS, LOST, LATE)}
    harmful_count = counts[LOST] + counts[LATE]
    flown = chosen(pairs, judged=True)
    complete = chosen(flown, complete=True)
    harmful, harmless = chosen(flown, harm=(LOST, LATE)), chosen(complete, harm=HARMLESS)
    latencies_s = known(numbers(harmful, "latency_s"))
    middle = _interval(latencies_s, median)
    late = _interval(latencies_s, lambda drawn: np.quantile(drawn, 0.95, axis=-1))
    inactive = chosen(pairs, active=False, complete=True, struck=True)
    return FaultRow(
        by=by,
        value=value,
        detector=detector,
        planned=bare.num_rows,
        not_injected=bare.num_rows - injected.num_rows,
        not_activated=injected.num_rows - active.num_rows,
        golden_failed=active.num_rows - judged.num_rows,
        active=judged.num_rows,
        crashed=int(flags(judged, "crashed").sum()),
        harmful=wilson(harmful_count, judged.num_rows),
        lost=counts[LOST],
        longer=counts[LATE],
        flown=flown.num_rows,
        not_struck=chosen(flown, struck=False).num_rows,
        latency_s=middle,
        latency_s_p95=late,
        latency_ticks=middle.value * TICKS_PER_S,
        latency_ticks_p95=late.value * TICKS_PER_S,
        detected_harmful=_share(chosen(harmful, struck=True), "seen"),
        detected_active=_share(chosen(complete, struck=True), "seen"),
        detected_inactive=_share(inactive, "seen"),
        by_chance=_share(chosen(complete, struck=True), "by_chance"),
        recovered=_share(chosen(harmful, harm=LOST), "won"),
        undone=_share(harmful, "undone"),
        added=_share(harmless, "undone", wanted=False),
        unprotected=_share(judged, "faulty_won"),
        protected=mixture(
            [(harmful_count, _share(harmful, "won")), (counts[HARMLESS], _share(harmless, "won"))]
        ),
        success=_ends(complete, "faulty_won"),
        worst=_worst(flown),
    )


def _share(pairs: pa.Table, column: str, *, wanted: bool = True) -> Share:
    return wilson(int((flags(pairs, column) == wanted).sum()), pairs.num_rows)


def _ends(pairs: pa.Table, first: str) -> McNemar:
    return McNemar.of(flags(pairs, first), flags(pairs, "won"))


def _worst(pairs: pa.Table) -> _WorstFlight:
    # A failed flight has no flight time and is never the longest.
    faulty, protected = (
        np.nan_to_num(numbers(pairs, name), nan=-math.inf)
        for name in ("faulty_lengthening", "lengthening")
    )
    usable = np.isfinite(faulty) | np.isfinite(protected)
    if not (np.isfinite(faulty).any() and np.isfinite(protected).any()):
        usable[:] = False
    faulty, protected = faulty[usable], protected[usable]

    def recovered(rows: IntArray) -> FloatArray:
        """Return how much the detector reduces the largest increase, for each of k resamples.

        `rows` has the shape (k, n) and holds the indices of the missions in each resample. The
        result has the shape (k,).
        """
        # A resample in which all flights of a kind failed counts as having no increase.
        worst = [np.maximum(times[rows].max(axis=-1), 0.0) for times in (faulty, protected)]
        return np.asarray(worst[0] - worst[1])

    worst = WorstCase.of(OWN, (1.0 + faulty).tolist(), (1.0 + protected).tolist())
    longer = 1.0 + worst.increase > LONGER
    return _WorstFlight(
        faulty=worst.increase,
        protected=worst.protected_worst - 1.0,
        recovered=interval_of_rows(len(faulty), recovered, resamples=RESAMPLES),
        recovered_share=worst.recovered_share if longer else math.nan,
    )


def _interval(values: FloatArray, statistic: Callable[[FloatArray], FloatArray]) -> Interval:
    return interval(values, statistic, resamples=RESAMPLES)
