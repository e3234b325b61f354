"""All bit operations of the project.

A value is handled as its *pattern*: an unsigned Python integer whose bit 0 is least significant.
Layouts of binary32 and binary64: IEEE 754-2019, section 3.4.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mavfi_cli.core.errors import FaultSpecError

Scalar = float | int | bool


class Field(Enum):
    """The part of a value whose bits are flipped."""

    SIGN = "sign"
    EXPONENT = "exponent"
    MANTISSA = "mantissa"
    ANY = "any"


# struct format codes of a value and of the unsigned integer of the same size.
_FORMATS = {
    "float64": ("<d", "<Q"), "float32": ("<f", "<I"), "int8": ("<b", "<B"), "int16": ("<h", "<H"),
    "int32": ("<i", "<I"), "int64": ("<q", "<Q"), "bool": ("<?", "<B"),
    "uint8": ("<B", "<B"), "uint16": ("<H", "<H"), "uint32": ("<I", "<I"), "uint64": ("<Q", "<Q"),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class BitType:
    """The bit layout of a type: its name, its width, and the bits of its fields."""

    name: str
    width: int
    fields: dict[Field, range]

    @classmethod
    def raw(cls, size_bytes: int) -> BitType:
        """Return the type of a register or memory operand, whose only field is ANY."""
        width = 8 * size_bytes
        return cls(name=f"raw{width}", width=width, fields={Field.ANY: range(width)})

    def field_bits(self, field: Field) -> range:
        """Return the positions of the bits in `field`.

        Raises:
            FaultSpecError: the type has no such field.
        """
        try:
            return self.fields[field]
        except KeyError:
            raise self._lacks(field.value, [known.value for known in self.fields]) from None

    def _lacks(self, field: str, known: Iterable[str]) -> FaultSpecError:
        return FaultSpecError(f"{self.name} has no field {field!r}; it has: {', '.join(known)}")

    def mask(self, bits: Iterable[int]) -> int:
        """Return an integer with the given bits set, which inverts them by exclusive or.

        Raises:
            FaultSpecError: the type does not have one of the bits.
        """
        mask = 0
        for bit in bits:
            if not 0 <= bit < self.width:
                raise FaultSpecError(
                    f"bit of {self.name} must be between 0 and {self.width - 1}, got {bit}"
                )
            mask |= 1 << bit
        return mask

    def draw(
        self, rng: np.random.Generator, *, field: Field = Field.ANY, count: int = 1
    ) -> tuple[int, ...]:
        """Draw `count` distinct bits of a field uniformly, and return them in ascending order.

        Raises:
            FaultSpecError: the type has no such field, or the field has fewer than `count` bits.
        """
        candidates = self.field_bits(field)
        if not 1 <= count <= len(candidates):
            wanted = f"{field.value} of at least {count} bits"
            known = [f"{name.value} ({len(bits)})" for name, bits in self.fields.items()]
            raise self._lacks(wanted, known)
        chosen = rng.choice(len(candidates), size=count, replace=False)
        return tuple(sorted(candidates[int(index)] for index in chosen))

    def pattern(self, value: Scalar) -> int:
        """Return the bit pattern of a value, as an unsigned integer.

        A value of type float32 is first rounded to the nearest binary32 number.
        """
        of_value, of_pattern = _FORMATS[self.name]
        return int(struct.unpack(of_pattern, struct.pack(of_value, value))[0])

    def value(self, pattern: int) -> Scalar:
        """Return the value that a bit pattern represents.

        A signalling float32 NaN may become quiet, because Python holds every float as binary64.
        """
        of_value, of_pattern = _FORMATS[self.name]
        value: Scalar = struct.unpack(of_value, struct.pack(of_pattern, pattern))[0]
        return value

    def flip(self, value: Scalar, bits: Iterable[int]) -> Scalar:
        """Return the value whose bit pattern is that of `value` with `bits` inverted."""
        return self.value(self.pattern(value) ^ self.mask(bits))


def _float_type(name: str, mantissa: int, exponent: int) -> BitType:
    width = mantissa + exponent + 1
    return BitType(
        name=name,
        width=width,
        fields={
            Field.SIGN: range(width - 1, width),
            Field.EXPONENT: range(mantissa, width - 1),
            Field.MANTISSA: range(mantissa),
            Field.ANY: range(width),
        },
    )


FLOAT64 = _float_type("float64", 52, 11)
FLOAT32 = _float_type("float32", 23, 8)
INT8, INT16, INT32, INT64 = (
    BitType(name=f"int{w}", width=w, fields={Field.SIGN: range(w - 1, w), Field.ANY: range(w)})
    for w in (8, 16, 32, 64)
)
_UNSIGNED = tuple(
    BitType(name=f"uint{w}", width=w, fields={Field.ANY: range(w)}) for w in (8, 16, 32, 64)
)
BOOL = BitType(name="bool", width=1, fields={Field.ANY: range(1)})


def bits_of(mask: int) -> tuple[int, ...]:
    """Return the indices of the set bits of a mask in ascending order."""
    return tuple(bit for bit in range(mask.bit_length()) if mask >> bit & 1)


def flip_bytes(data: bytes, bits: Iterable[int]) -> bytes:
    """Return a copy of `data` with `bits` inverted, where bit 8 is bit 0 of the second byte."""
    pattern = int.from_bytes(data, "little") ^ BitType.raw(len(data)).mask(bits)
    return pattern.to_bytes(len(data), "little")


NUMPY_TYPES = {kind.name: kind for kind in (
    FLOAT64, FLOAT32, INT8, INT16, INT32, INT64, BOOL, *_UNSIGNED,
)}  # fmt: skip


def format_distinct(*values: object) -> list[str]:
    """Format values with six significant digits, or all digits if two values would look equal."""
    short = [f"{value:.6g}" if isinstance(value, float) else str(value) for value in values]
    return short if len(set(short)) == len(short) else [repr(value) for value in values]
