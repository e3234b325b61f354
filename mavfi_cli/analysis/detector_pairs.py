"""Pairs of flights of one mission: golden, faulty, and faulty with a detector."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from enum import Enum
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import chosen
from mavfi_cli.campaigns.missions import Injected

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


class Harm(Enum):
    """Effect of a fault on an unprotected flight, compared with its golden flight."""

    NONE = "none"
    LOST = "lost"  # the golden flight reached the goal, this one did not
    LONGER = "longer"  # both did, this one took more than LONGER longer
    OTHERWISE = "otherwise"  # both failed, in different ways


def _harm_of(golden: Flight, flown: Flight) -> Harm:
    """Effect of a treatment on a mission, compared with its golden flight.

    A mission that succeeds although its golden flight failed is not harmed.
    """
    if flown["succeeded"]:
        longer = golden["succeeded"] and (_lengthening(golden, flown) or 0.0) > LONGER
        return Harm.LONGER if longer else Harm.NONE
    if golden["succeeded"]:
        return Harm.LOST
    return Harm.NONE if flown["outcome"] == golden["outcome"] else Harm.OTHERWISE


def _lengthening(golden: Flight, flown: Flight) -> float | None:
    """Flight time over golden flight time, minus 1; None if either flight failed."""
    if not (golden["succeeded"] and flown["succeeded"]):
        return None
    if not golden["flight_time_s"] or flown["flight_time_s"] is None:
        return None
    return float(flown["flight_time_s"] / golden["flight_time_s"] - 1.0)


def _common(kind: str, golden: Flight, flown: Flight) -> dict[str, Any]:
    """Columns of all pairs."""
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
        "harm": harm.value if active else "",
        "crashed": faulty["crashed"],
        "faulty_outcome": faulty["outcome"],
        "faulty_time_s": faulty["flight_time_s"],
        "struck_s": struck_s,
        "alarm_s": alarm and alarm["stamp_s"],
        "alarm_stage": alarm and alarm["stage"],
        "latency_s": None if alarm is None else max(0.0, alarm["stamp_s"] - struck_s),
        "by_chance": _first_alarm(watched, struck_s) is not None,
        "remaining_harm": remaining.value if active else "",
        "faulty_won": faulty["succeeded"],
        "active": active,
        "struck": struck_s is not None,
        "seen": alarm is not None,
        "undone": remaining is Harm.NONE,
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
    return active.filter(pc.not_equal(active["harm"], Harm.NONE.value))
