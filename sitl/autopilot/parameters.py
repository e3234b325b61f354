"""The parameter store and its wire form: REAL32, or INT32 bytewise in the float field."""

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
    """What became of a PARAM_SET."""

    CHANGED = "changed"
    UNCHANGED = "unchanged"  # same value, or a value that is refused: the answer is the old value
    IGNORED = "ignored"  # unknown name or wrong type: PX4 stays silent


class Parameters:
    """Values by name and by index.

    `value` is what a client stored; `effective` is what the flight code may use, inside the
    parameter's limits, so that no stored value can put the vehicle into an undefined state.
    """

    def __init__(self, system_id: int) -> None:
        self._table = parameter_table(system_id)
        self._index = {row.name: number for number, row in enumerate(self._table)}
        self._values: list[float | int] = [_stored(row, row.default) for row in self._table]

    def __len__(self) -> int:
        return len(self._table)

    def index(self, name: str) -> int | None:
        """The index of a name; None where there is none."""
        return self._index.get(name)

    def value(self, name: str) -> float | int:
        """The stored value of a name that exists."""
        return self._values[self._index[name]]

    def effective(self, name: str) -> float:
        """The stored value, held inside the parameter's limits."""
        number = self._index[name]
        row = self._table[number]
        return float(min(max(self._values[number], row.low), row.high))

    def write(self, name: str, wire_value: float, wire_type: int) -> SetResult:
        """Store what a PARAM_SET carries, decoded by its type.

        A value that is not finite is refused (a real PX4 stores it and then hangs), and so is
        any change of a read-only parameter.
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
        """PARAM_VALUE of an index that exists."""
        row, value = self._table[index], self._values[index]
        wire = _float_of_bytes(struct.pack("<i", value)) if row.is_integer else value
        return _value_message(row.name, wire, _wire_type(row), len(self), index)

    def hash_message(self) -> Any:
        """PARAM_VALUE of the pseudo-parameter that tells a client whether its cache is good."""
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
    """The value at the precision that the wire has."""
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
