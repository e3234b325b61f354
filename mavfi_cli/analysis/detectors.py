"""Evaluate detectors with and without faults: counts of pairs, each with its interval.

Pairs are flights of one mission: golden, faulty, and faulty with a detector. Faults that were not
injected or not read are counted separately and enter no other number. The detectors fly all harmful
faults, and the harmless ones of the `complete` missions. The effect of a fault is taken from the
unprotected flight, because a detector may withhold the value before it is read.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import IntArray, chosen, flags, known, numbers
from mavfi_cli.analysis.pairs import paired
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.core.types import FloatArray
from mavfi_cli.link.session import SessionSettings
from mavfi_cli.stats.bootstrap import interval, interval_of_rows, median
from mavfi_cli.stats.paired import OWN, McNemar, holm, worst_case
from mavfi_cli.stats.roc import curves
from mavfi_cli.stats.shares import Interval, Share, mixture, rate

LONGER = 0.05  # fraction of the golden flight time beyond which a fault is harmful
NONE = "none"  # no detector: the reference of all others
ERROR_FREE, FAULT = "error-free", "fault"  # kinds of missions
KEY = ("world", "seed", "level", "stage", "target", "field")  # labels; a golden flight has two
Flight = Mapping[str, Any]  # a row of `analysis.flights`
Place = tuple[str, str, tuple[Any, ...]]  # kind, detector, KEY
# Columns from which pairs are made; the labels are those of KEY, the kind and the detector.
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
    CSV | dict.fromkeys(("golden_won", "faulty_won", "won", "active", "struck", "seen", "undone",
                         "complete"), _FLAG)
    | {"faulty_lengthening": _NUMBER, "faulty_struck_s": _NUMBER, "golden_path": _TEXT,
       "faulty_path": _TEXT}
)  # fmt: skip


# Effects of a fault on an unprotected flight, compared with its golden flight.
HARMLESS = "none"
LOST = "lost"  # the golden flight reached the goal, this one did not
LATE = "longer"  # both did, this one took more than LONGER longer
OTHERWISE = "otherwise"  # both failed, in different ways


def _harm_of(golden: Flight, flown: Flight) -> str:
    """Effect of a treatment on a mission, compared with its golden flight.

    A mission that succeeds although its golden flight failed is not harmed.
    """
    if flown["succeeded"]:
        longer = golden["succeeded"] and (_lengthening(golden, flown) or 0.0) > LONGER
        return LATE if longer else HARMLESS
    if golden["succeeded"]:
        return LOST
    return HARMLESS if flown["outcome"] == golden["outcome"] else OTHERWISE


def _lengthening(golden: Flight, flown: Flight) -> float | None:
    """Flight time over golden flight time, minus 1; None if either flight failed."""
    if not (golden["succeeded"] and flown["succeeded"]):
        return None
    if not golden["flight_time_s"] or flown["flight_time_s"] is None:
        return None
    return float(flown["flight_time_s"] / golden["flight_time_s"] - 1.0)


def _common(kind: str, golden: Flight, flown: Flight) -> dict[str, Any]:
    return {
        "kind": kind,
        "golden_outcome": golden["outcome"],
        "golden_time_s": golden["flight_time_s"],
        "golden_won": golden["succeeded"],
        "outcome": flown["outcome"],
        "time_s": flown["flight_time_s"],
        "won": flown["succeeded"],
        "lengthening": _lengthening(golden, flown),
        "alarms": flown["alarm_count"] or 0,
        "episodes": flown["episodes"],
    }


def _first_alarm(flown: Flight, from_s: float | None) -> Mapping[str, Any] | None:
    """The first alarm at that time or later; None if there is none."""
    if from_s is None:
        return None
    return next((alarm for alarm in flown["alarms"] if alarm["stamp_s"] >= from_s - 1e-9), None)


def _fault_pair(
    labels: Mapping[str, Any],
    golden: Flight,
    faulty: Flight,
    watched: Flight,
    protected: Flight,
    *,
    complete: bool,
) -> dict[str, Any]:
    """A golden flight, the same with a fault, and with fault and detector, as a row of SCHEMA.

    `active`: the unprotected flight was struck, and something read it or may have. `struck`: the
    protected flight was; otherwise there was nothing to detect. `seen`: it had an alarm at or
    after the strike. `by_chance`: the detector also raises one after that time without the fault.

    Args:
        watched: the golden flight with the detector.
        protected: the faulty flight itself for the detector `none`.
        complete: whether all faults of its mission are flown with detectors; otherwise only
            harmful ones are.
    """
    active = faulty["injected"] in (Injected.ACTIVE.value, Injected.UNREAD.value)
    harm, remaining = _harm_of(golden, faulty), _harm_of(golden, protected)
    struck_s = protected["struck_s"]
    alarm = _first_alarm(protected, struck_s)
    return {
        **labels,
        **_common(FAULT, golden, protected),
        "state": "+".join(faulty["struck_sites"]) or labels["target"],
        "bits": " ".join(map(str, faulty["first_bits"])),
        "injected": faulty["injected"],
        "harm": harm if active else "",
        "crashed": faulty["crashed"],
        "faulty_outcome": faulty["outcome"],
        "faulty_time_s": faulty["flight_time_s"],
        "struck_s": struck_s,
        "alarm_s": alarm and alarm["stamp_s"],
        "alarm_stage": alarm and alarm["stage"],
        "latency_s": None if alarm is None else max(0.0, alarm["stamp_s"] - struck_s),
        "by_chance": _first_alarm(watched, struck_s) is not None,
        "remaining_harm": remaining if active else "",
        "faulty_won": faulty["succeeded"],
        "active": active,
        "struck": struck_s is not None,
        "seen": alarm is not None,
        "undone": remaining == HARMLESS,
        "complete": complete,
        "faulty_lengthening": _lengthening(golden, faulty),
        "faulty_struck_s": faulty["struck_s"],
        "faulty_path": faulty["path"],
    }


def pairs_of(
    flights: Iterable[pa.Table], detectors: Collection[str], complete: Callable[[int], bool]
) -> tuple[pa.Table, pa.Table]:
    """All pairs whose flights are complete: without faults, and with one.

    Args:
        flights: ended flights with labels for kind, detector and KEY, in the order of the pairs.
        complete: whether all faults of the mission with this seed are flown with detectors.
    """
    known = {place: row for table in flights for place, row in _placed(table)}
    free, struck = [], []
    for (kind, detector, key), flight in known.items():
        mission = (*key[:2], *[None] * (len(KEY) - 2))
        golden = known.get((ERROR_FREE, NONE, mission))
        watched = known.get((ERROR_FREE, detector, mission))
        faulty = known.get((kind, NONE, key))
        if detector not in detectors or golden is None:
            continue
        if kind == ERROR_FREE:
            labels = {"world": key[0], "seed": key[1], "detector": detector}
            told = _common(ERROR_FREE, golden, flight)
            free.append({**labels, **told, "golden_path": golden["path"]})
        elif watched is not None and faulty is not None:
            labels = {**dict(zip(KEY, key, strict=True)), "detector": detector}
            whole = complete(key[1])
            struck.append(_fault_pair(labels, golden, faulty, watched, flight, complete=whole))
    return pa.Table.from_pylist(free, SCHEMA), pa.Table.from_pylist(struck, SCHEMA)


def _placed(table: pa.Table) -> Iterator[tuple[Place, Flight]]:
    names = [name for name in ("kind", "detector", *KEY) if f"label_{name}" in table.column_names]
    for row in table.select([*(f"label_{name}" for name in names), *WANTED]).to_pylist():
        key = tuple(row.get(f"label_{name}") for name in KEY)
        yield (str(row["label_kind"]), str(row["label_detector"]), key), row


def harmful(faults: pa.Table) -> pa.Table:
    """The pairs without a detector whose fault was active and did harm."""
    active = chosen(faults, active=True, detector=NONE)
    return active.filter(pc.not_equal(active["harm"], HARMLESS))


RESAMPLES = 999
TICKS_PER_S = SessionSettings().state_rate_hz  # one control tick per state message
ALL = "all"
GROUPS = (ALL, "world", "stage", "field", "state")  # labels by which faults are grouped
_NOTHING_SEEN = -math.log(0.025)  # upper 95 % limit of a Poisson count that was 0
# Harmful faults with their scores, and the scores of error-free flights, for each detector.
Scored = Callable[[str], tuple[pa.Table, list[float]]]


def found(
    detectors: Sequence[str], error_free: pa.Table, faults: pa.Table, scored: Scored
) -> dict[str, Any]:
    """Results of the pairs, one row per group and detector, as plain values.

    Args:
        detectors: all of them, `none` first.
        error_free, faults: as `pairs_of` returns them.
        scored: for each detector its harmful faults with the columns `stage`, `field` and `score`,
            and the scores of its error-free flights.
    """
    return {
        "error_free": [
            {"by": by, "value": value, "detector": detector, **_error_free_metrics(part)}
            for by, value, detector, part in _grouped(detectors, error_free, (ALL, "world"))
        ],
        "faults": [
            {
                "by": by,
                "value": value,
                "detector": detector,
                **_fault_metrics(_part(faults, by, value, NONE), part),
            }
            for by, value, detector, part in _grouped(detectors, faults, GROUPS)
        ],
        "comparisons": _comparisons(detectors, faults),
        "curves": {name: _curves(*scored(name)) for name in detectors if name != NONE},
    }


def _grouped(
    detectors: Sequence[str], pairs: pa.Table, groups: Sequence[str]
) -> Iterator[tuple[str, str, str, pa.Table]]:
    """Group, value, detector and pairs, in the order of first occurrence of the values."""
    for by in groups:
        values = pc.unique(pairs[by]).to_pylist() if by != ALL else [ALL] * bool(pairs.num_rows)
        for value, detector in itertools.product(values, detectors):
            yield by, value, detector, _part(pairs, by, value, detector)


def _part(pairs: pa.Table, by: str, value: str, detector: str) -> pa.Table:
    return chosen(pairs, detector=detector, **({} if by == ALL else {by: value}))


def _comparisons(detectors: Sequence[str], faults: pa.Table) -> list[dict[str, Any]]:
    """Compare every two detectors on the same faults, with p-values corrected over all."""
    rows: list[dict[str, Any]] = []
    for first, second in itertools.combinations(detectors, 2):
        tests = _recoveries_compared(*(chosen(faults, detector=name) for name in (first, second)))
        row: dict[str, Any] = {"first": first, "second": second}
        for what, test in zip(("recovered", "undone"), tests, strict=True):
            row[what] = {**asdict(test), "difference": test.difference}
        rows.append(row)
    for what in ("recovered", "undone"):
        corrected = holm([row[what]["p_value"] for row in rows])
        for row, p_value in zip(rows, corrected, strict=True):
            row[what]["corrected_p"] = p_value
    return rows


def _curves(scores: pa.Table, error_free: Sequence[float]) -> dict[str, Any]:
    told = ("positives", "area", "area_low", "area_high", "average_precision")
    areas = []
    for by in ("stage", "field"):
        for value in pc.unique(scores[by]).to_pylist():
            part = curves(chosen(scores, **{by: value})["score"].to_pylist(), error_free)
            areas.append({"by": by, "value": value, **{name: part[name] for name in told}})
    return {**curves(scores["score"].to_pylist(), error_free), "areas": areas}


# Without faults -------------------------------------------------------------------------------


def _error_free_metrics(pairs: pa.Table) -> dict[str, Any]:
    """A detector on flights without faults, compared with the same flights without it.

    Returns:
        `hours`: flight time with the detector, from take-over to the end of the mission.
        `alarms`, `episodes`: all alarms, and consecutive ones as one. `alarms_per_hour`: bootstrap
        over flights; with no alarm at all, a Poisson upper limit. `with_alarm`: flights with at
        least one. `lost`: golden successes that failed with the detector; `gained`: the other way
        round.
        `success`: McNemar's test, golden first. `lengthening`: median of flight time over golden
        flight time, minus 1, of both successful.
    """
    alarms = numbers(pairs, "alarms")
    hours = np.nan_to_num(numbers(pairs, "time_s")) / 3600.0
    test = _ends(pairs, "golden_won")
    return {
        "flights": pairs.num_rows,
        "hours": math.fsum(hours.tolist()),
        "alarms": int(alarms.sum()),
        "episodes": int(numbers(pairs, "episodes").sum()),
        "alarms_per_hour": asdict(_rate_per_hour(alarms, hours)),
        "with_alarm": asdict(rate(int(np.count_nonzero(alarms)), pairs.num_rows)),
        "lost": asdict(rate(test.only_first, test.both + test.only_first)),
        "gained": test.only_second,
        "success": asdict(test),
        "lengthening": asdict(_interval(known(numbers(pairs, "lengthening")), median)),
    }


def _rate_per_hour(alarms: FloatArray, hours: FloatArray) -> Interval:
    """Over the flights that have a flight time; a mission that was cut off has none."""
    alarms, hours = alarms[hours > 0.0], hours[hours > 0.0]
    total = float(hours.sum())
    if total > 0.0 and not alarms.any():
        return Interval(value=0.0, low=0.0, high=_NOTHING_SEEN / total, count=len(alarms))
    return interval_of_rows(
        len(alarms),
        lambda rows: alarms[rows].sum(axis=-1) / hours[rows].sum(axis=-1),
        resamples=RESAMPLES,
    )


# With faults ----------------------------------------------------------------------------------


def _fault_metrics(bare: pa.Table, pairs: pa.Table) -> dict[str, Any]:
    """A detector on flights with faults.

    Args:
        bare: the faults without a detector, all of them.
        pairs: those that were flown with the detector.

    Returns:
        `planned`: number of faults, divided into `not_injected`, `not_activated` (never read) and
        `active`. Unless stated otherwise, all other numbers concern the active ones.
        `crashed`: faults that killed a node, which are noticed without any detector. `harmful`:
        lost, longer or otherwise; their numbers follow. `flown`: with this detector: all harmful
        faults, and the harmless ones of complete missions. `not_struck`: those that never struck
        because the protected flight had diverged; they enter no rate of detection.
        `detected_harmful`: with an alarm at or after the strike. `detected_active`: the same of all
        faults of complete missions. `detected_inactive`: the same of faults that were struck but
        not activated. `by_chance`: flights of complete missions that have an alarm in that time
        without their fault as well. `latency_s`, `latency_ticks`: median and 95th percentile from
        strike to alarm, harmful faults. `recovered`: of the lost missions those that succeed with
        protection. `undone`: of the harmful faults those that do no harm with it. `added`: of the
        harmless faults those that do harm with it. `golden`, `unprotected`: success rates of all
        missions with an active fault. `protected`: the same with the detector: harmful and harmless
        faults, each with its own rate, weighted by how many there are. `success`: McNemar's test on
        complete missions, unprotected first. `worst`: as `_worst`, of the flown faults.
    """
    injected = bare.filter(pc.not_equal(bare["injected"], Injected.NOT_INJECTED.value))
    active = chosen(injected, active=True)
    harms = {harm: chosen(active, harm=harm).num_rows for harm in (HARMLESS, LOST, LATE, OTHERWISE)}
    harmful_count = active.num_rows - harms[HARMLESS]
    flown = chosen(pairs, active=True)
    complete = chosen(flown, complete=True)
    harmful = flown.filter(pc.not_equal(flown["harm"], HARMLESS))
    harmless = chosen(complete, harm=HARMLESS)
    latencies_s = known(numbers(harmful, "latency_s"))
    middle, late = (
        _interval(latencies_s, median),
        _interval(latencies_s, lambda drawn: np.quantile(drawn, 0.95, axis=-1)),
    )
    protected = mixture(
        [(harmful_count, _share(harmful, "won")), (harms[HARMLESS], _share(harmless, "won"))]
    )
    return {
        "planned": bare.num_rows,
        "not_injected": bare.num_rows - injected.num_rows,
        "not_activated": injected.num_rows - active.num_rows,
        "active": active.num_rows,
        "crashed": int(flags(active, "crashed").sum()),
        "harmful": asdict(rate(harmful_count, active.num_rows)),
        **{harm: harms[harm] for harm in (LOST, LATE, OTHERWISE)},
        "flown": flown.num_rows,
        "not_struck": chosen(flown, struck=False).num_rows,
        "latency_s": asdict(middle),
        "latency_s_p95": asdict(late),
        "latency_ticks": middle.value * TICKS_PER_S,
        "latency_ticks_p95": late.value * TICKS_PER_S,
        **{name: asdict(share) for name, share in {
            "detected_harmful": _share(chosen(harmful, struck=True), "seen"),
            "detected_active": _share(chosen(complete, struck=True), "seen"),
            "detected_inactive": _share(
                chosen(pairs, active=False, complete=True, struck=True), "seen"
            ),
            "by_chance": _share(chosen(complete, struck=True), "by_chance"),
            "recovered": _share(chosen(harmful, harm=LOST), "won"),
            "undone": _share(harmful, "undone"),
            "added": _share(harmless, "undone", wanted=False),
            "golden": _share(active, "golden_won"),
            "unprotected": _share(active, "faulty_won"),
        }.items()},
        "protected": protected,
        "success": asdict(_ends(complete, "faulty_won")),
        "worst": _worst(flown),
    }  # fmt: skip


def _recoveries_compared(first: pa.Table, second: pa.Table) -> tuple[McNemar, McNemar]:
    """Two detectors on the same harmful faults: lost missions recovered, and harm undone."""
    here, there = paired(chosen(first, active=True), second, KEY)
    harm = here["harm"]

    def test(among: pa.Array, column: str) -> McNemar:
        return McNemar.of(*(flags(each.filter(among), column) for each in (here, there)))

    lost, harmful = pc.equal(harm, LOST), pc.not_equal(harm, HARMLESS)
    return test(lost, "won"), test(harmful, "undone")


def _share(pairs: pa.Table, column: str, *, wanted: bool = True) -> Share:
    return rate(int((flags(pairs, column) == wanted).sum()), pairs.num_rows)


def _ends(pairs: pa.Table, first: str) -> McNemar:
    return McNemar.of(flags(pairs, first), flags(pairs, "won"))


def _worst(pairs: pa.Table) -> dict[str, Any]:
    """The worst successful flight time and its recovery, as in the paper's section VII-A.

    The paper flies one world with one seed. Here every mission has its own seed, so every
    flight is compared with its own golden flight.

    Returns:
        `faulty`, `protected`: the largest flight time over golden flight time, minus 1.
        `recovered`: how much lower the second is, in parts of the golden flight time. Resampled
        missions never hold a worse case than the worst that was seen, so the interval says how much
        it hangs on single flights, not how bad it can become. `recovered_share`: of the increase;
        not a number where no flight was LONGER.
    """
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
        """Reduction of the worst increase by protection, (k,), for resamples of missions (k, n)."""
        # A resample without a successful flight of a kind counts as having no longer flight.
        worst = [np.maximum(each[rows].max(axis=-1), 0.0) for each in (faulty, protected)]
        return np.asarray(worst[0] - worst[1])

    worst = worst_case(OWN, (1.0 + faulty).tolist(), (1.0 + protected).tolist())
    return {
        "faulty": worst["increase"],
        "protected": worst["protected_worst"] - 1.0,
        "recovered": asdict(interval_of_rows(len(faulty), recovered, resamples=RESAMPLES)),
        "recovered_share": worst["recovered_share"] if worst["increase"] > LONGER else math.nan,
    }


def _interval(values: FloatArray, statistic: Callable[[FloatArray], FloatArray]) -> Interval:
    return interval(values, statistic, resamples=RESAMPLES)
