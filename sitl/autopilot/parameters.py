"""Parameter store and its wire format: REAL32, or INT32 bytewise in the float field."""

from __future__ import annotations

import math
import struct
import zlib
from enum import Enum
from typing import Any

from mavfi_cli.link.codec import dialect
from sitl.autopilot.parameter_table import Parameter, parameter_table

TYPE_UINT32 = 5
TYPE_INT32 = 6
TYPE_REAL32 = 9
HASH_NAME = "_HASH_CHECK"
HASH_INDEX = 65535


class SetResult(Enum):
    """Result of a PARAM_SET."""

    CHANGED = "changed"
    UNCHANGED = "unchanged"  # same or rejected value; the answer is the old value
    IGNORED = "ignored"  # unknown name or wrong type; no answer, as in PX4


class Parameters:
    """Parameter values by name and by index.

    `value` returns the stored value. `effective` returns the value for the flight code, within the
    parameter's limits, so that no stored value can cause an undefined state.
    """

    def __init__(self, system_id: int) -> None:
        self._table = parameter_table(system_id)
        self._index = {row.name: number for number, row in enumerate(self._table)}
        self._values: list[float | int] = [_stored(row, row.default) for row in self._table]

    def __len__(self) -> int:
        return len(self._table)

    def index(self, name: str) -> int | None:
        """Return the index of a name; None if it is unknown."""
        return self._index.get(name)

    def value(self, name: str) -> float | int:
        """Return the stored value of a known name."""
        return self._values[self._index[name]]

    def effective(self, name: str) -> float:
        """Return the stored value, clamped to the parameter's limits."""
        number = self._index[name]
        row = self._table[number]
        return float(min(max(self._values[number], row.low), row.high))

    def write(self, name: str, wire_value: float, wire_type: int) -> SetResult:
        """Store the value of a PARAM_SET, decoded by its type.

        A value that is not finite is rejected (a real PX4 stores it and then hangs). A change of a
        read-only parameter is rejected, too.
        """
        number = self._index.get(name)
        if number is None or wire_type != _wire_type(self._table[number]):
            return SetResult.IGNORED
        row = self._table[number]
        value: float | int = _int_of_float(wire_value) if row.is_integer else wire_value
        if row.read_only or not math.isfinite(value) or value == self._values[number]:
            return SetResult.UNCHANGED
        self._values[number] = _stored(row, value)
        return SetResult.CHANGED

    def message(self, index: int) -> Any:
        """Return the PARAM_VALUE of a valid index."""
        row, value = self._table[index], self._values[index]
        wire = _float_of_bytes(struct.pack("<i", value)) if row.is_integer else value
        return _value_message(row.name, wire, _wire_type(row), len(self), index)

    def hash_message(self) -> Any:
        """Return the PARAM_VALUE of the hash, with which a client validates its cache."""
        digest = 0
        for row, value in zip(self._table, self._values, strict=True):
            packed = struct.pack("<i" if row.is_integer else "<f", value)
            digest = zlib.crc32(row.name.encode() + packed, digest)
        wire = _float_of_bytes(struct.pack("<I", digest))
        return _value_message(HASH_NAME, wire, TYPE_UINT32, len(self), HASH_INDEX)


def _value_message(name: str, wire: float, kind: int, count: int, index: int) -> Any:
    return dialect.MAVLink_param_value_message(name.encode(), wire, kind, count, index)


def _wire_type(row: Parameter) -> int:
    return TYPE_INT32 if row.is_integer else TYPE_REAL32


def _stored(row: Parameter, value: float) -> float | int:
    """Return the value rounded to the wire's precision."""
    if row.is_integer:
        return int(value)
    single: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return single


def _float_of_bytes(data: bytes) -> float:
    value: float = struct.unpack("<f", data)[0]
    return value


def _int_of_float(value: float) -> int:
    number: int = struct.unpack("<i", struct.pack("<f", value))[0]
    return number
