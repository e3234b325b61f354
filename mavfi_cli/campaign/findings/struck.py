"""What a fault did, as columns of an export: from the record that the ledger keeps of a mission.

A source-level fault that struck several components has them joined by ";", in one order in all
columns; of several strikes the columns have the first. What a record does not have is None.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mavfi_cli.fi import bits

Record = Mapping[str, Any]
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
COLUMNS = (*_BOTH, *_SOURCE, *_INSTRUCTION)
_FLOATS = {len("0x") + 16: "float64", len("0x") + 8: "float32"}  # by the digits of their bits


def struck(result: Record) -> dict[str, Any]:
    """COLUMNS of a mission.

    Args:
        result: its result.json, or what is known of it.
    """
    fault: Record = result.get("fault") or {}
    found = _instruction(fault, result) if fault.get("level") == "instruction" else _source(fault)
    return {name: found.get(name) for name in COLUMNS}


def _source(fault: Record) -> dict[str, Any]:
    strikes: Sequence[Record] = fault.get("strikes") or ()
    if not strikes:
        return {"strikes": fault.get("strike_count")}
    first = strikes[0]
    changes: Sequence[Record] = first["changes"]
    activation: Record = fault.get("activation") or {}
    reader: Record = activation.get("first_reader") or {}
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
        "activation": activation.get("activation"),
        "first_reader": reader.get("name"),
        "first_read_state": reader.get("state"),
        "first_read_s": reader.get("stamp_s"),
    }


def _instruction(fault: Record, result: Record) -> dict[str, Any]:
    corruption: Record = fault.get("corruption") or {}
    injection: Record = fault.get("injection") or {}
    activation: Record = fault.get("activation") or {}
    node: Record = (result.get("nodes") or {}).get(fault.get("node")) or {}
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
    ends = [crash["how"] for crash in node.get("crashes", ())] + ["hang"] * node.get("hangs", 0)
    return {
        **drawn,
        "strike_s": fault.get("stamp_s"),
        "struck_before_hex": injection["before"],
        "struck_after_hex": injection["after"],
        "activation": activation.get("activation"),
        "reading_instruction": activation.get("instruction") or None,
        "node_ended": ";".join(ends) or None,
    }


def _joined(values: Any) -> str:
    return ";".join(map(str, values))


def _bits(places: Sequence[int]) -> str:
    return " ".join(map(str, places))


def _value(change: Record, when: str) -> Any:
    """A value; what JSON cannot hold, infinities and NaN, from its bits."""
    value, pattern = change[when], change[f"{when}_hex"]
    if value is not None:
        return value
    return bits.value_of(int(pattern, 16), bits.NUMPY_TYPES[_FLOATS[len(pattern)]])
