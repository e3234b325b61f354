"""Parameters of the autopilot with PX4's names, types and defaults, and their wire format.

`parameters.toml` lists them. Some act on the flight. The others exist because ground stations
request them. Limits apply to the values that the flight code uses, not to stored values, because
PX4 stores any value. On the wire a value is a REAL32, or an INT32 whose bytes fill the float field.
"""

from __future__ import annotations

import math
import struct
import tomllib
import zlib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from mavfi_cli.link.codec import dialect

TYPE_INT32: int = dialect.MAV_PARAM_TYPE_INT32
TYPE_REAL32: int = dialect.MAV_PARAM_TYPE_REAL32
HASH_NAME = "_HASH_CHECK"
_TABLES = Path(__file__).with_suffix(".toml")


class _Parameter(NamedTuple):
    """One parameter of the autopilot: name of up to 16 characters, default and usable range."""

    name: str
    default: float | int  # the type of the default is the type of the parameter
    low: float = -math.inf
    high: float = math.inf
    read_only: bool = False

    @property
    def wire_type(self) -> int:
        """MAV_PARAM_TYPE of the value on the wire."""
        return TYPE_INT32 if isinstance(self.default, int) else TYPE_REAL32

    def packed(self, value: float) -> bytes:
        """Return the four bytes of a value on the wire."""
        return struct.pack("<i" if self.wire_type == TYPE_INT32 else "<f", value)

    def stored(self, value: float) -> float | int:
        """Return the value rounded to the wire's precision."""
        layout = "<i" if self.wire_type == TYPE_INT32 else "<f"
        rounded: float | int = struct.unpack(layout, self.packed(value))[0]
        return rounded


@cache
def _parameter_table(system_id: int) -> tuple[_Parameter, ...]:
    """Return all parameters in index order, which is alphabetical."""
    tables = tomllib.loads(_TABLES.read_text(encoding="utf-8"))
    rows = [
        *(_Parameter(name, *values) for name, values in tables["acting"].items()),
        *(_Parameter(name, default) for name, default in tables["present"].items()),
        _Parameter("MAV_COMP_ID", 1, read_only=True),
        _Parameter("MAV_SYS_ID", system_id, read_only=True),
    ]
    return tuple(sorted(rows, key=lambda row: row.name))


class Parameters:
    """The autopilot's parameter values, which can be accessed by name and by index.

    `value` returns the stored value. `effective` returns the value for the flight code, within the
    parameter's limits, so that no stored value can cause an undefined state.
    """

    def __init__(self, system_id: int) -> None:
        self._table = _parameter_table(system_id)
        self._index = {row.name: number for number, row in enumerate(self._table)}
        self._values: list[float | int] = [row.stored(row.default) for row in self._table]
        self._effective: dict[str, float] = {}  # cache, cleared at every change

    def restore(self, other: Parameters) -> None:
        """Copy all values from the parameters of another autopilot with the same system id."""
        self._values = list(other._values)
        self._effective.clear()

    def __len__(self) -> int:
        return len(self._table)

    def index(self, name: str) -> int | None:
        """Return the index of a parameter by its name, or None if the name is unknown."""
        return self._index.get(name)

    def value(self, name: str) -> float | int:
        """Return the stored value of a parameter, whose name must be known."""
        return self._values[self._index[name]]

    def effective(self, name: str) -> float:
        """Return the stored value of a parameter, clamped to its limits. The name must be known."""
        known = self._effective.get(name)
        if known is None:
            number = self._index[name]
            row = self._table[number]
            known = float(min(max(self._values[number], row.low), row.high))
            self._effective[name] = known
        return known

    def write(self, name: str, wire_value: float, wire_type: int) -> bool | None:
        """Store the value of a PARAM_SET, decoded by its type. Return True if it has changed.

        An unknown name or a wrong type is ignored, as in PX4, and returns None. A value that is not
        finite is rejected (a real PX4 stores it and then hangs), and so is a change to a read-only
        parameter. A rejected or unchanged value returns False.
        """
        number = self._index.get(name)
        if number is None or wire_type != self._table[number].wire_type:
            return None
        row = self._table[number]
        value: float | int = wire_value
        if wire_type == TYPE_INT32:
            (value,) = struct.unpack("<i", struct.pack("<f", wire_value))
        if row.read_only or not math.isfinite(value) or value == self._values[number]:
            return False
        self._values[number] = row.stored(value)
        self._effective.clear()
        return True

    def message(self, index: int) -> Any:
        """Return the PARAM_VALUE message of the parameter with a valid index."""
        row = self._table[index]
        return self._message(row.name, row.packed(self._values[index]), row.wire_type, index)

    def hash_message(self) -> Any:
        """Return the PARAM_VALUE message with the hash by which a client validates its cache."""
        digest = 0
        for row, value in zip(self._table, self._values, strict=True):
            digest = zlib.crc32(row.name.encode() + row.packed(value), digest)
        packed = struct.pack("<I", digest)
        return self._message(HASH_NAME, packed, dialect.MAV_PARAM_TYPE_UINT32, 65535)

    def _message(self, name: str, packed: bytes, kind: int, index: int) -> Any:
        (wire,) = struct.unpack("<f", packed)
        return dialect.MAVLink_param_value_message(name.encode(), wire, kind, len(self), index)
