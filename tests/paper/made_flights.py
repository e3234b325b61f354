"""Hand-made tables of flights, with the columns that layouts read."""

import json

import pyarrow as pa

from mavfi_cli.analysis.pairs import Flights

_KINDS = {
    "number": pa.int64(), "pair": pa.string(), "world": pa.string(), "planner": pa.string(),
    "platform": pa.string(), "level": pa.string(), "fault_target": pa.string(),
    "fault_seed": pa.int64(), "fault_bits": pa.int64(), "fault_field": pa.string(),
    "node_ended": pa.string(), "detector": pa.string(), "protect": pa.string(),
    "state": pa.string(), "outcome": pa.string(),
    "flight_time_s": pa.float64(), "distance_m": pa.float64(), "energy_regression_j": pa.float64(),
    "replans": pa.int64(), "check_share": pa.float64(), "path": pa.string(),
    "changes": pa.string(),
    **{f"recovery_share_{stage}": pa.float64() for stage in ("perception", "planning", "control")},
}  # fmt: skip
_USUAL = {
    "world": "sparse", "planner": "rrtstar", "platform": "x86", "state": "flown",
    "outcome": "success", "distance_m": 50.0, "energy_regression_j": 10_000.0, "replans": 1,
}  # fmt: skip


def flight(pair, time_s, **values):
    """One golden flight, or one with the values of a fault and a detector."""
    if values.get("detector") and "protect" not in values:
        values["protect"] = "perception+planning+control"
    lost = {"outcome": "collision", "flight_time_s": None} if time_s is None else {}
    return {**_USUAL, "pair": pair, "flight_time_s": time_s, **values, **lost}


def struck(pair, time_s, **values):
    """One flight with a fault."""
    return flight(pair, time_s, **{"level": "instruction", "fault_target": "planning", **values})


def table(*flights):
    """The table of flights, numbered in order."""
    rows = [{"number": number, **each, **_mission(each)} for number, each in enumerate(flights)]
    columns = {
        name: pa.array([row.get(name) for row in rows], kind) for name, kind in _KINDS.items()
    }
    return Flights.of(pa.table(columns))


def _mission(each):
    """Flights of one pair in other places are other missions; the fault is told as in a ledger."""
    place = [each[name] for name in ("pair", "world", "planner", "platform")]
    fault = {name: each.get(name) for name in _KINDS if name.startswith("fault_")}
    level = {"instruction": "instruction", "source": "fault"}.get(each.get("level"))
    return {"pair": " ".join(place), "changes": json.dumps({level: fault} if level else {})}
