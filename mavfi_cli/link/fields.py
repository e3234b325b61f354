"""The fields of MAVLink messages as states that a fault can strike.

A state is named MESSAGE.FIELD, or MESSAGE.FIELD[INDEX] for an element of an array or a character of
a text, which counts as a byte. The elements of an array form a group, and so do fields whose names
differ only in a final x, y or z.
"""

from __future__ import annotations

import copy
import difflib
from dataclasses import dataclass
from typing import Any

from mavfi_cli.core.errors import UnknownName
from mavfi_cli.core.types import DType, Scalar, State
from mavfi_cli.link.codec import ADDED, Codec, Message, dialect

_TYPES = {
    "float": DType.FLOAT32, "double": DType.FLOAT64, "char": DType.UINT8,
    "uint8_t_mavlink_version": DType.UINT8,
}  # fmt: skip
_SETPOINTS = (
    "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT", "SET_ATTITUDE_TARGET",
)  # fmt: skip
# Bits of a setpoint's type_mask that make the autopilot ignore a field; see
# POSITION_TARGET_TYPEMASK and ATTITUDE_TARGET_TYPEMASK.
_IGNORED = {
    "x": 1, "y": 2, "z": 4, "lat_int": 1, "lon_int": 2, "alt": 4, "vx": 8, "vy": 16, "vz": 32,
    "afx": 64, "afy": 128, "afz": 256, "yaw": 1024, "yaw_rate": 2048,
    "body_roll_rate": 1, "body_pitch_rate": 2, "body_yaw_rate": 4, "thrust": 64, "q": 128,
}  # fmt: skip


class _WireState(State):
    """A number of a MAVLink message, an element of an array, or a byte of a text."""

    __slots__ = ()

    def read(self, message: Message, index: int) -> Scalar:
        """Return the field's value in a received message. `index` is ignored."""
        content = self._content(message)
        number: Scalar = content if self.column is None else content[self.column]
        return number

    def write(self, message: Message, index: int, value: Scalar) -> Message:
        """Return a copy of a received message in which this field has the given value.

        The copy still has the old frame, and of a text only the raw bytes differ. `index` is
        ignored.
        """
        changed, content = copy.copy(message), self._content(message)
        if self.column is None:
            content = value
        else:
            content = type(content)([*content[: self.column], value, *content[self.column + 1 :]])
        setattr(changed, self.source, content)
        return changed

    def _content(self, message: Message) -> Any:
        """Return the field. A text reaches at least to this byte, because the codec cuts zeros."""
        content: Any = getattr(message, self.source)
        if self.column is not None and isinstance(content, bytes):
            return content.ljust(self.column + 1, b"\0")
        return content


@dataclass(frozen=True, slots=True, kw_only=True)
class WireFields:
    """The fields of one MAVLink message type, as states keyed by name."""

    name: str
    number: int  # message id
    states: dict[str, State]

    @classmethod
    def of(cls, name: str) -> WireFields:
        """Return the fields of the message type `name`.

        If only ArduPilot has this message, all codecs of the process decode ArduPilot's messages
        from now on.

        Raises:
            UnknownName: Neither the `common` dialect nor ArduPilot has such a message. The error
                suggests the nearest.
        """
        if name not in (kinds := _kinds()):
            Codec.add_ardupilot()
        if name not in (kinds := _kinds()):
            near = difflib.get_close_matches(name, kinds, 6, 0.0)
            raise UnknownName("message", name, near)
        kind: Any = kinds[name]
        states: dict[str, State] = {}
        of_fields = zip(kind.fieldnames, kind.fieldtypes, strict=True)
        counts = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
        for field, wire in of_fields:
            unit = getattr(kind, "fieldunits_by_name", {}).get(field, "1")
            dtype = _TYPES.get(wire) or DType(wire.removesuffix("_t"))
            triple = {f"{field[:-1]}{axis}" for axis in "xyz"}
            together = field in triple and len(triple & {*kind.fieldnames}) > 1
            shared = f"{field[:-1]}*" if together else field
            source = f"_{field}_raw" if wire == "char" else field
            for column in range(counts[field]) or [None]:
                full = f"{name}.{field}" + ("" if column is None else f"[{column}]")
                states[full] = _WireState(
                    full, kind, source, unit, column=column, dtype=dtype, group=f"{name}.{shared}"
                )
        return cls(name=name, number=kind.id, states=states)


def _kinds() -> dict[str, type[Message]]:
    """Return the known message classes by name."""
    return {kind.msgname: kind for kind in (*dialect.mavlink_map.values(), *ADDED.values())}


def is_ignored(message: Message, state: State) -> bool:
    """Return True if a message is a setpoint whose mask tells the autopilot to ignore `state`."""
    mask = getattr(message, "type_mask", 0) if message.get_type() in _SETPOINTS else 0
    return bool(mask & _IGNORED.get(state.source, 0))
