"""Flown missions as one table, each beside its golden flight and its flight without detector.

Items and claims choose rows of this table (`analysis.flights.chosen`) and count its columns.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import COSTS, chosen, flown, known, numbers
from mavfi_cli.campaigns.missions import Injected, canonical
from mavfi_cli.core.types import FloatArray, Outcome, Stage
from mavfi_cli.spec.detector import PAPER
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.stats.shares import Share, wilson

STAGES = tuple(stage.value for stage in Stage)
EVERY_STAGE = "+".join(STAGES)
LONGER = 1.05  # a flight is longer if it takes more than this times its own golden flight
_COLUMNS: Mapping[str, pa.DataType] = {
    **dict.fromkeys(("number", "seed", "fault_bits"), pa.int64()),
    **dict.fromkeys((
        "pair", "world", "planner", "platform", "stack", "level", "fault_target", "fault_field",
        "detector", "protect", "state", "outcome", "injected", "activation",
        "strike_phase", "struck_state", "struck_bits", "struck_kernel", "node_ended", "path",
        "changes",
    ), pa.string()),
    **dict.fromkeys((
        "flight_time_s", "distance_m", "min_clearance_m", "goal_distance_m", "energy_regression_j",
        "energy_propeller_j", "replans", *COSTS,
    ), pa.float64()),
}  # fmt: skip
_STRUCK = (Injected.ACTIVE, Injected.UNREAD, Injected.CAUGHT, Injected.NOT_ACTIVATED)
_FAULTS = ("fault", "instruction")
# A mission is one of the paper's if it differs from the defaults in these only, and its fault in
# _DRAWN only.
_PAPER = {*_FAULTS, "detector", "isolate", "stack", "world", "seed", "world_seed", "planner",
          "platform", "time_limit_s"}  # fmt: skip
_DRAWN = {"target", "seed", "field", "bits", "together", "at"}
_USUAL: Mapping[str, Any] = json.loads(canonical({
    "fault": asdict(FaultConfig(target="")), "instruction": asdict(InstructionConfig(target="")),
}))  # fmt: skip
_NO_FAULT = canonical([None] * len(_FAULTS))
_NO, _YES = pa.scalar(False), pa.scalar(True)  # noqa: FBT003


def flown_missions(table: pa.Table) -> pa.Table:
    """The missions that flew, in the columns that items and claims read.

    Beside columns of the argument, which are empty if it lacks them:
        fault: the fault that was asked for, as text; equal faults have equal texts.
        together: whether it strikes all components of a group at once.
        at: when a source-level fault strikes; empty without one.
        as_paper: whether all but stack, detector's model and that moment is as in the paper:
            vehicle, speed, sensors, one flip of drawn bits, and 13 watched states.
        struck: whether the fault flipped a bit, read or not, as the paper counts.
        lost: whether the mission did not end in success.

    Args:
        table: of `analysis.flights.flights`, or of an export.
    """
    there = set(table.column_names)
    table = flown(pa.table({
        name: table[name].cast(kind) if name in there else pa.nulls(table.num_rows, kind)
        for name, kind in _COLUMNS.items()
    }))  # fmt: skip
    configs = [json.loads(each) for each in table["changes"].to_pylist()]
    flips = pc.is_in(table["injected"], pa.array([each.value for each in _STRUCK]))
    kills = pc.fill_null(pc.starts_with(table["fault_target"], "process."), _NO)
    lost = pc.fill_null(pc.not_equal(table["outcome"], Outcome.SUCCESS.value), _YES)
    faults = (canonical([each.get(name) for name in _FAULTS]) for each in configs)
    at = ((each.get("fault") or {}).get("at") for each in configs)
    together = (bool((each.get("fault") or {}).get("together")) for each in configs)
    return with_columns(
        table,
        fault=pa.array(faults, pa.string()),
        together=pa.array(together, pa.bool_()),
        at=pa.array(at, pa.string()),
        as_paper=pa.array(map(_as_paper, configs), pa.bool_()),
        struck=pc.and_not(flips, kills),
        lost=lost,
    )


def with_columns(table: pa.Table, **columns: Any) -> pa.Table:
    """The table with more columns."""
    for name, column in columns.items():
        table = table.append_column(name, column)
    return table


def _as_paper(config: Mapping[str, Any]) -> bool:
    watch = (config.get("detector") or {}).get("watch", PAPER)
    changed = {
        name
        for level in _FAULTS
        for name, value in (config.get(level) or {}).items()
        if value != _USUAL[level].get(name)
    }
    return config.keys() <= _PAPER and changed <= _DRAWN and watch == PAPER


_NOTHING_FLOWN = flown_missions(pa.table({}))


def beside_golden(table: pa.Table) -> pa.Table:
    """The flights with what each is compared with.

    Of its golden flight:
        own_lost: whether that is lost; empty if it is not there.
        own_flight_time_s: its flight time.
        over_own: flight time over it; empty if one of the two is lost.
        harmed: whether the flight is lost, or takes more than LONGER times as long; empty unless
            the golden flight succeeds.
    Of the flight with the same fault and no detector, empty if that is not there: bare_struck,
    bare_lost, bare_over_own, bare_harmed.

    Args:
        table: of `flown_missions`.
    """
    unprotected = pc.is_null(table["detector"]).to_pylist()
    faults = faults_of(table)
    place_of = {fault: place for place, fault in enumerate(faults) if unprotected[place]}
    own = pa.array([place_of.get((pair, _NO_FAULT)) for pair, _ in faults], pa.int64())
    bare = pa.array([place_of.get(fault) for fault in faults], pa.int64())
    own_lost, own_time = (table[name].take(own) for name in ("lost", "flight_time_s"))
    succeeds = pc.equal(own_lost, _NO)
    ratio = pc.divide(table["flight_time_s"], own_time)
    over_own = pc.if_else(pc.and_not(succeeds, table["lost"]), ratio, pa.scalar(None, ratio.type))
    harmed = pc.or_(table["lost"], pc.fill_null(pc.greater(over_own, LONGER), _NO))
    harmed = pc.if_else(succeeds, harmed, pa.scalar(None, pa.bool_()))
    table = with_columns(
        table, own_lost=own_lost, own_flight_time_s=own_time, over_own=over_own, harmed=harmed
    )
    names = ("struck", "lost", "over_own", "harmed")
    return with_columns(table, **{f"bare_{name}": table[name].take(bare) for name in names})


def pooled(tables: Iterable[pa.Table], stack: str | None = None) -> pa.Table:
    """The missions of several tables, each once; None means all stacks.

    Args:
        tables: of `flown_missions`.
    """
    whole = pa.concat_tables([_NOTHING_FLOWN, *tables]).combine_chunks()
    whole = whole if stack is None else chosen(whole, stack=stack)
    first: dict[str, int] = {}
    for place, changes in enumerate(whole["changes"].to_pylist()):
        first.setdefault(changes, place)
    return beside_golden(whole.take(pa.array(first.values(), pa.int64())))


# Rows and numbers ---------------------------------------------------------------------------------


def golden(flights: pa.Table) -> pa.Table:
    """The flights without fault and detector."""
    return chosen(flights, level=None, detector=None)


def faulty(flights: pa.Table, detector: str | None = None, **values: object) -> pa.Table:
    """The flights with a fault, without a detector or with this one."""
    return chosen(flights.filter(pc.is_valid(flights["level"])), detector=detector, **values)


def struck(flights: pa.Table, **values: object) -> pa.Table:
    """The flights with a flipped bit, and no detector unless one is named."""
    return chosen(flights, **{"struck": True, "detector": None, **values})


def timed(flights: pa.Table) -> pa.Table:
    """The flights with a fault that succeed as their golden flights do."""
    return flights.filter(pc.and_(pc.is_valid(flights["level"]), pc.is_valid(flights["over_own"])))


def comparable(flights: pa.Table) -> pa.Table:
    """The flights without a detector, or with one that watches all stages."""
    return chosen(flights, protect=(None, EVERY_STAGE))


def by_value(flights: pa.Table, *names: str) -> dict[tuple[Any, ...], pa.Table]:
    """The flights of each combination of values, in the order of their first flights."""
    places: dict[tuple[Any, ...], list[int]] = {}
    for place, values in enumerate(zip(*(flights[n].to_pylist() for n in names), strict=True)):
        places.setdefault(values, []).append(place)
    return {values: flights.take(pa.array(each)) for values, each in places.items()}


def share(flights: pa.Table, column: str = "lost", *, value: bool = True) -> Share:
    """The share of flights in which a column has a value, among those in which it is not empty."""
    values = flights[column].drop_null()
    return wilson(pc.sum(pc.equal(values, value)).as_py() or 0, len(values))


def ratios(flights: pa.Table) -> FloatArray:
    """Times over those of the golden flights of the same missions, where both succeed."""
    return known(numbers(flights, "over_own"))


def faults_of(flights: pa.Table) -> list[tuple[str, str]]:
    """Mission and fault of each flight; two flights of one fault differ in their detector."""
    return list(zip(flights["pair"].to_pylist(), flights["fault"].to_pylist(), strict=True))
