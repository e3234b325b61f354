"""The sections and the measures of a flight: the one place where a result.json is read.

Each measure is a column of a table of flights. A mission that crashed or hung before it could write
its record has few fields; a measure that its record does not have is None. A source-level fault
that struck several components has them joined by ";", in one order in all measures; of several
strikes the measures have the first.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from mavfi_cli.core.types import Outcome
from mavfi_cli.fi import bits
from mavfi_cli.mission.record.quality import QUALITY

Record = Mapping[str, Any]
_PLACES = {
    **{name: ("quality_of_flight", name) for name in QUALITY},
    "replans": ("pilot", "replans"),
    "simulated_s": ("simulated_s",),
    "response_median_s": ("response_time_s", "median"),
    "response_p95_s": ("response_time_s", "p95"),
    "alarm_count": ("detection", "alarm_count"),
    "hover_shaft_w": ("referee", "physics", "hover_shaft_w"),
}
_BOTH = (
    "strikes", "strike_s", "strike_invocation", "struck_bits", "struck_before_hex",
    "struck_after_hex", "activation",
)  # fmt: skip
_SOURCE = (
    "strike_phase", "strike_tick", "struck_state", "struck_index", "struck_before",
    "struck_after", "first_reader", "first_read_state", "first_read_s",
)  # fmt: skip
_INSTRUCTION = (
    "struck_node", "struck_kernel", "struck_function", "struck_address", "struck_instruction",
    "struck_execution", "struck_role", "struck_register", "reading_instruction", "node_ended",
)  # fmt: skip
STRUCK = (*_BOTH, *_SOURCE, *_INSTRUCTION)
_FLOATS = {len("0x") + 16: "float64", len("0x") + 8: "float32"}  # by the digits of their bits


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRecord:
    """The sections of a result.json. A section without content is empty, or None if it is a value.

    A mission that crashed or hung before it could write its record lacks most of them.
    """

    outcome: str = ""
    reason: str = ""
    simulated_s: float | None = None
    goal_enu_m: Sequence[float] | None = None
    config: Record = field(default_factory=dict)
    quality_of_flight: Record = field(default_factory=dict)
    pilot: Record = field(default_factory=dict)
    events: Sequence[dict[str, Any]] = ()
    plans: Sequence[Record] = ()
    plan_failures: Mapping[str, int] = field(default_factory=dict)  # by reason; if any failed
    fault: Record = field(default_factory=dict)
    detection: Record = field(default_factory=dict)
    nodes: Record = field(default_factory=dict)
    kernels: Record = field(default_factory=dict)
    response_time_s: Record = field(default_factory=dict)
    measured_platform: Record = field(default_factory=dict)
    world: Record = field(default_factory=dict)
    referee: Record | None = field(default_factory=dict)  # None: the vehicle left no truth
    versions: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)  # SHA-256 of the user's files
    host: Record = field(default_factory=dict)

    @property
    def succeeded(self) -> bool:
        """True if the vehicle reached the goal."""
        return self.outcome == Outcome.SUCCESS.value

    @property
    def interrupted(self) -> bool:
        """True if the user interrupted the flight, so that the mission has no outcome."""
        return self.outcome == Outcome.INTERRUPTED.value

    @property
    def golden(self) -> bool:
        """True if the flight has neither a fault nor a detector."""
        return not (self.fault or self.detection)


_SECTIONS = frozenset(each.name for each in fields(FlightRecord))


def record_of(result: Record) -> FlightRecord:
    """Read the sections of a result.json."""
    known = {name: result[name] for name in _SECTIONS & result.keys()}
    return FlightRecord(
        **{name: value for name, value in known.items() if value is not None or name == "referee"}
    )


def measures_of(record: Record) -> dict[str, Any]:
    """All measures of a mission.

    Beside those that are fields of the record: `straight_m`, from the take-off point to the edge of
    the goal's tolerance; `crashed`, whether a node died; `struck_s`, `struck_sites` and
    `first_bits`, when the fault was applied, and to what; `alarms`, those that are listed, oldest
    first; `episodes`, alarms in a row counted once; and STRUCK.
    """
    nodes: Record = record.get("nodes") or {}
    return {
        **fields_of(record),
        "straight_m": _straight_m(record),
        "crashed": any(node.get("crashes") for node in nodes.values()),
        **_alarms(record.get("detection") or {}),
        **_applied(record.get("fault") or {}),
        **struck(record),
    }


def fields_of(record: Record) -> dict[str, Any]:
    """The measures that are fields of a record."""
    return {name: _at(record, *place) for name, place in _PLACES.items()}


def _at(record: Record, *place: str) -> Any:
    """A field of a field; None where either is missing."""
    found: Any = record
    for name in place:
        found = (found or {}).get(name)
    return found


def _straight_m(record: Record) -> float | None:
    config, start, goal = record.get("config"), _at(record, "world", "start"), "goal_enu_m"
    if not config or start is None or record.get(goal) is None:
        return None
    east, north, up = start
    takeoff = (east, north, up + config["takeoff_height_m"])
    return math.dist(takeoff, record[goal]) - float(config["goal_tolerance_m"])


def _alarms(detection: Record) -> dict[str, Any]:
    return {
        "alarms": [
            {"stamp_s": alarm["stamp_s"], "stage": alarm["stage"]}
            for alarm in detection.get("alarms", ())
        ],
        "episodes": sum(each["count"] for each in detection.get("recoveries", {}).values()),
    }


def _applied(fault: Record) -> dict[str, Any]:
    """The first time of the fault, and the states or the node that it was applied to."""
    applied = fault.get("state") == "applied"
    if fault.get("level") == "source":
        strikes = fault.get("strikes") or []
        changes = strikes[0]["changes"] if strikes else []  # none where a process was killed
        return {
            "struck_s": strikes[0]["stamp_s"] if applied and strikes else None,
            "struck_sites": list(fault.get("states", ())),
            "first_bits": list(changes[0]["bits"]) if changes else [],
        }
    return {
        "struck_s": fault.get("stamp_s") if applied else None,
        "struck_sites": [fault["node"]] if "node" in fault else [],
        "first_bits": list((fault.get("corruption") or {}).get("bits", ())),
    }


# What a fault did -----------------------------------------------------------------------------


def struck(record: Record) -> dict[str, Any]:
    """STRUCK of a mission."""
    fault: Record = record.get("fault") or {}
    found = _instruction(fault, record) if fault.get("level") == "instruction" else _source(fault)
    return {name: found.get(name) for name in STRUCK}


def _source(fault: Record) -> dict[str, Any]:
    strikes: Sequence[Record] = fault.get("strikes") or ()
    if not strikes:
        return {"strikes": fault.get("strike_count")}
    first = strikes[0]
    changes: Sequence[Record] = first["changes"]
    reader: Record = _at(fault, "activation", "first_reader") or {}
    return {
        "strikes": fault.get("strike_count"),
        "strike_s": first["stamp_s"],
        "strike_phase": first["phase"],
        "strike_tick": first["tick"],
        "strike_invocation": first["invocation"],
        "struck_state": _joined(change["state"] for change in changes),
        "struck_index": _joined(change["index"] for change in changes),
        "struck_bits": _joined(_bits(change["bits"]) for change in changes),
        "struck_before": _joined(_value(change, "before") for change in changes),
        "struck_after": _joined(_value(change, "after") for change in changes),
        "struck_before_hex": _joined(change["before_hex"] for change in changes),
        "struck_after_hex": _joined(change["after_hex"] for change in changes),
        "activation": _at(fault, "activation", "activation"),
        "first_reader": reader.get("name"),
        "first_read_state": reader.get("state"),
        "first_read_s": reader.get("stamp_s"),
    }


def _instruction(fault: Record, record: Record) -> dict[str, Any]:
    corruption: Record = fault.get("corruption") or {}
    injection: Record = fault.get("injection") or {}
    drawn = {
        "struck_node": fault.get("node"),
        "struck_kernel": fault.get("kernel"),
        "struck_function": fault.get("symbol"),
        "struck_address": f"{fault['object']}+{fault['offset']:#x}" if "object" in fault else None,
        "struck_instruction": fault.get("instruction"),
        "struck_execution": fault.get("k"),
        "struck_role": corruption.get("role"),
        "struck_register": corruption.get("register") or corruption.get("site"),
        "struck_bits": _bits(corruption["bits"]) if corruption else None,
        "strike_invocation": fault.get("invocation"),
        "strikes": int(injection["applied"]) if injection else None,  # cut off: who knows
    }
    if not injection.get("applied"):
        return drawn
    node: Record = (record.get("nodes") or {}).get(fault.get("node")) or {}
    ends = [crash["how"] for crash in node.get("crashes", ())] + ["hang"] * node.get("hangs", 0)
    return {
        **drawn,
        "strike_s": fault.get("stamp_s"),
        "struck_before_hex": injection["before"],
        "struck_after_hex": injection["after"],
        "activation": _at(fault, "activation", "activation"),
        "reading_instruction": _at(fault, "activation", "instruction") or None,
        "node_ended": ";".join(ends) or None,
    }


def _joined(values: Iterable[Any]) -> str:
    return ";".join(map(str, values))


def _bits(places: Sequence[int]) -> str:
    return " ".join(map(str, places))


def _value(change: Record, when: str) -> Any:
    """A value; what JSON cannot hold, infinities and NaN, from its bits."""
    value, pattern = change[when], change[f"{when}_hex"]
    if value is not None:
        return value
    return bits.value_of(int(pattern, 16), bits.NUMPY_TYPES[_FLOATS[len(pattern)]])
