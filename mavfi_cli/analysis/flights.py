"""A campaign as one table: one row per finished mission, in the order of the mission list.

The configurations come from the mission list, the results from the records. The table is a
`pyarrow.Table`; its method `to_pandas()` turns it into a data frame.
"""

from __future__ import annotations

import json
import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from mavfi_cli.campaigns.ledger import (
    METADATA,
    STRATUM,
    WEIGHT,
    Ledger,
    stored_export,
    stored_provenance,
)
from mavfi_cli.campaigns.missions import (
    COUNTED,
    Labels,
    MissionResult,
    PlannedMission,
    ResultState,
    canonical,
    changes_of,
)
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.core.types import FloatArray, Outcome
from mavfi_cli.mission.measures import (
    QUALITY,
    RECOMPUTED,
    STRUCK,
    DetectionCost,
    FlightRecord,
    measures_of,
)
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.bootstrap import RESAMPLES, interval
from mavfi_cli.stats.shares import Interval

CONFIG = ("world", "seed", "world_seed", "planner", "platform", "stack", "vehicle")
FAULT = ("target", "seed", "bits", "field")
COSTS = ("check_share", *(f"recovery_share_{stage}" for stage in RECOMPUTED))
EXPORTED = (
    "number", "pair", *CONFIG, "level", *(f"fault_{name}" for name in FAULT), *STRUCK, "detector",
    "protect", "state", "outcome", "reason", "injected", *QUALITY, "replans", "simulated_s",
    "wall_s", "alarm_count", *COSTS, "attempts", "path", STRATUM, WEIGHT, "changes",
)  # fmt: skip
BITS = pa.list_(pa.list_(pa.int64()))  # a list of bits for each struck component
_TYPES = {  # types of the columns that are not text, for tables in which they hold no value
    "struck_bits": BITS,
    **dict.fromkeys(
        ("number", "seed", "world_seed", "fault_seed", "fault_bits", "strikes", "strike_invocation",
         "strike_tick", "struck_execution", "replans", "alarm_count", "attempts"), pa.int64()),
    **dict.fromkeys(
        (*QUALITY, *COSTS, WEIGHT, "strike_s", "first_read_s", "simulated_s", "wall_s"),
        pa.float64()),
}  # fmt: skip
# Labels in which protected flights differ from unprotected ones.
TREATMENT = ("setting", "detector", "model", "threshold", "protect", "any_stack", "watch")
SETTLING = "settling"  # metadata of a reproduction that settled claims (`reproduce --settle`)
_HOST = ("machine", "cores", "started")
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def flights(ledger: Ledger, among: Sequence[int] | None = None) -> pa.Table:
    """Return a table with one row per finished mission, in the order of the mission list.

    Missions that could not begin have the state `error`. The columns are the measures of
    `mission.measures`, the requested values of CONFIG, the fields FAULT of the fault as
    `fault_NAME`, each label as `label_NAME`, and all labels as text in `labels`. `succeeded` means
    that the mission reached its goal. `counted` means that the mission is golden, or that its fault
    struck, unless the struck value expired before anything read it. `check_share` and
    `recovery_share_STAGE` are the shares of the flight time that detection and recovery take.
    `weight` is the number of uniformly drawn missions that a mission of a `stratum` stands for.

    Args:
        among: numbers of the missions to include; None includes all.
    """
    if ledger.export is not None:
        table = _updated(ledger.export, ledger.folder)
        return table if among is None else chosen(table, number=(*among,))
    labels = sorted({name for cell in ledger.cells() for name in cell})
    rows = [_row(entry, labels) for entry in ledger.results(among)]
    names = _row(_NOTHING, labels)  # gives the columns even without results
    return pa.table({name: _column([row[name] for row in rows]) for name in names})


_NOTHING = MissionResult(
    number=0, mission=PlannedMission(config=MissionConfig()), state=ResultState.ERROR, outcome=None,
    reason="", result={}, injected=None, wall_s=0.0, attempts=0, path=None,
)  # fmt: skip


def _row(entry: MissionResult, labels: Sequence[str]) -> dict[str, Any]:
    config, detector = entry.mission.config, entry.mission.config.detector
    fault = config.fault or config.instruction
    level = None if fault is None else "instruction" if config.fault is None else "source"
    injected = None if entry.injected is None else entry.injected.value
    shares: list[float | None] = [None] * len(COSTS)
    flight = entry.flight
    cost = DetectionCost.of(flight)
    if cost is not None:
        recovery = (cost.recovery_s[stage] / cost.flight_s for stage in RECOMPUTED)
        shares = [cost.detection_share, *recovery]
    return {
        "number": entry.number,
        "pair": entry.mission.pair,
        "labels": canonical(dict(entry.mission.labels)),
        **{f"label_{name}": entry.mission.labels.get(name) for name in labels},
        **{name: getattr(config, name) for name in CONFIG},
        "level": level,
        **{f"fault_{name}": None if fault is None else getattr(fault, name) for name in FAULT},
        "detector": None if detector is None else detector.name,
        "protect": None if detector is None else "+".join(detector.protect),
        "changes": canonical(changes_of(config)),
        "state": entry.state.value,
        "outcome": entry.outcome,
        "succeeded": entry.outcome == Outcome.SUCCESS.value,
        "counted": injected in COUNTED,
        "reason": entry.reason,
        "injected": injected,
        "wall_s": entry.wall_s,
        "attempts": entry.attempts,
        "path": None if entry.path is None else str(entry.path),
        STRATUM: entry.stratum,
        WEIGHT: entry.weight,
        **measures_of(flight),
        **dict(zip(COSTS, shares, strict=True)),
    }


def _column(values: Sequence[Any]) -> pa.Array:
    """Convert the values to a column of one type. Integers mixed with floats become floats.

    Any other mixture of types becomes text.
    """
    kinds = {type(value) for value in values if value is not None}
    if len(kinds) > 1 and kinds != {int, float}:
        values = [None if value is None else str(value) for value in values]
    return pa.array(values, pa.float64() if kinds == {int, float} else None)


def untreated(labels: Labels) -> str:
    """Return the labels without those in TREATMENT, as canonical text.

    Protected and unprotected flights with the same fault have the same text.
    """
    return canonical({name: value for name, value in labels.items() if name not in TREATMENT})


def chosen(table: pa.Table, **values: Any) -> pa.Table:
    """Return the rows whose columns have the given values.

    None matches a null, and a tuple matches any of its items.
    """
    for name, value in values.items():
        allowed = value if isinstance(value, tuple) else (value,)
        equal = (
            pc.is_null(table[name]) if v is None else pc.equal(table[name], v) for v in allowed
        )
        table = table.filter(reduce(pc.or_kleene, equal))
    return table


def flown(table: pa.Table) -> pa.Table:
    """Return the rows of the missions that were flown, without those that could not begin."""
    return table.filter(pc.equal(table["state"], ResultState.FLOWN.value))


def errors(table: pa.Table, phrase: str) -> list[str]:
    """Return one text for each mission that could not begin, made by formatting `phrase`.

    Args:
        phrase: format string that may contain `{number}`, `{labels}` and `{reason}`.
    """
    rows = table.select(["number", "labels", "state", "reason"]).to_pylist()
    return [phrase.format_map(row) for row in rows if row["state"] == ResultState.ERROR.value]


def numbers(table: pa.Table, name: str) -> FloatArray:
    """Return a column as an array of floats of shape (n,), with NaN for nulls."""
    column = table[name].cast(pa.float64())
    return np.asarray(column.fill_null(math.nan).to_numpy(), dtype=np.float64)


def flags(table: pa.Table, name: str) -> BoolArray:
    """Return a column as a boolean array of shape (n,), with False for nulls."""
    return np.asarray(table[name].to_numpy(zero_copy_only=False), dtype=bool)


def known(values: FloatArray) -> FloatArray:
    """Return the values that are not NaN."""
    return values[~np.isnan(values)]


def exported(ledger: Ledger) -> pa.Table:
    """Return the table that `mavfi campaign export` writes, with one row per finished mission.

    The rows are in the order of the mission list. The columns are EXPORTED and one per label. The
    metadata of the table contain the provenance of the campaign.
    """
    whole = flights(ledger)
    if ledger.export is not None:
        return whole
    labels = [name for name in whole.column_names if name.startswith("label_")]
    mine = _typed(whole.select([*EXPORTED[:2], *labels, *EXPORTED[2:]]))
    return mine.replace_schema_metadata({METADATA: canonical(provenance(ledger))})


def read_export(path: Path) -> pa.Table:
    """Read the table of a campaign from its exported .parquet file.

    Columns written by earlier versions are converted to the current types. The paths of run folders
    are null: the file may come from anybody, and may name any folder of this computer.

    Raises:
        RecordError: the file is missing or damaged.
    """
    table = _updated(stored_export(path), path)
    if (place := table.schema.get_field_index("path")) >= 0:
        table = table.set_column(place, "path", pa.nulls(table.num_rows, pa.string()))
    return table


def _updated(table: pa.Table, path: Path) -> pa.Table:
    place = table.schema.get_field_index("struck_bits")
    if place >= 0 and pa.types.is_string(table.schema.field(place).type):  # like "53;1 55"
        try:
            bits = [_parsed(text) for text in table["struck_bits"].to_pylist()]
        except ValueError as error:
            raise RecordError(
                f"{path}: the export of a campaign cannot be read ({error})"
            ) from None
        table = table.set_column(place, "struck_bits", pa.array(bits, BITS))
    return _typed(table)


def _parsed(text: str | None) -> list[list[int]] | None:
    if text is None:
        return None
    return [[*map(int, component.split())] for component in text.split(";")] if text else []


def _typed(table: pa.Table) -> pa.Table:
    """Cast columns that hold only nulls to the types that they have when they hold values."""
    kinds = {
        field.name: _TYPES.get(field.name, pa.string())
        for field in table.schema
        if pa.types.is_null(field.type)
    }
    return table.cast(
        pa.schema(
            [field.with_type(kinds.get(field.name, field.type)) for field in table.schema],
            table.schema.metadata,
        )
    )


def provenance(source: Ledger | pa.Table) -> dict[str, Any]:
    """Return the provenance of a campaign, from its ledger or from its exported table.

    Returns:
        A dictionary with the `name` of the campaign; `planned`, the number of missions on its list;
        `sampling`, how its faults were drawn; `settling`, how claims were settled; the `versions`
        of the programs; and `host`, with the `machine`, `cores` and `started` of the first record.
        The dictionary is empty if an exported table has no provenance.
    """
    table = source if isinstance(source, pa.Table) else source.export
    if table is not None:
        return stored_provenance(table)
    first = next(source.results(), None)
    record = FlightRecord() if first is None else first.flight
    return {
        "name": source.meta("name"),
        "planned": source.planned(),
        "sampling": source.sampling.value,
        SETTLING: json.loads(source.meta(SETTLING) or "null"),
        "versions": json.loads(source.meta("versions") or "{}") or record.versions,
        "host": {name: record.host[name] for name in _HOST if name in record.host},
    }


def changed(
    missions: Iterable[Hashable],
    first: Iterable[float],
    second: Iterable[float],
    *,
    ratio: bool = True,
    resamples: int = RESAMPLES,
) -> Interval:
    """Return the geometric mean of `second` / `first`, with its bootstrap confidence interval.

    The interval is computed from the logarithms of the ratios. Pairs with a value that is not
    positive are omitted. Several pairs of one mission are not independent, so their mean counts as
    one value.

    Args:
        missions: the mission of each of the n pairs, or another key that dependent pairs share.
        first, second: the two values of each pair.
        ratio: if False, return the arithmetic mean of `second` - `first` instead, for values that
            may be zero. Then only pairs with NaN are omitted.
    """
    changes: dict[Hashable, list[float]] = {}
    for mission, a, b in zip(missions, first, second, strict=True):
        if a > 0.0 and b > 0.0 if ratio else not math.isnan(b - a):
            changes.setdefault(mission, []).append(math.log(b / a) if ratio else b - a)
    means = [math.fsum(logs) / len(logs) for logs in changes.values()]
    mean = interval(means, resamples=resamples)
    if not ratio:
        return mean
    value, low, high = (math.exp(end) for end in (mean.value, mean.low, mean.high))
    return Interval(value=value, low=low, high=high, count=mean.count)


# One mission --------------------------------------------------------------------------------------

_COMPARED = frozenset(measures_of(FlightRecord())) | {"outcome"}


def mission_of(ledger: Ledger, number: int) -> tuple[MissionConfig, Mapping[str, Any]]:
    """Return the configuration of a mission, and its row in the table that `flights` returns.

    Raises:
        RecordError: the campaign cannot be read.
        ConfigError: no mission with this number has been flown.
    """
    for row in flights(ledger, [number]).to_pylist():
        if row["outcome"] is not None:
            (config,) = ledger.configs([number])
            return config, row
    problem = f"mission {number} has not been flown; the list has {number_span(ledger)}"
    raise ConfigError(problem, path=ledger.folder)


def number_span(ledger: Ledger) -> str:
    """Return the range of a campaign's mission numbers, such as `missions 0 to 199`."""
    numbers = [number for number, *_ in ledger.rows()]
    return f"missions {min(numbers)} to {max(numbers)}" if numbers else "no missions"


def differing(row: Mapping[str, Any], flight: FlightRecord) -> list[str]:
    """Return the names of the columns in which a repeated flight differs from the recorded row.

    Only the outcome and the measures are compared. Values with equal texts count as equal, because
    exports store columns of mixed types as text.

    Args:
        row: row of the first flight in the table that `flights` returns.
        flight: record of the repeated flight.
    """
    again = {**measures_of(flight), "outcome": flight.outcome}
    return [
        name
        for name, value in row.items()
        if name in _COMPARED and value != again[name] and str(value) != str(again[name])
    ]
