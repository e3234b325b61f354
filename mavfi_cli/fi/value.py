"""A bit flip in one value or in one element of an array, without a mission."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import FaultSpecError, named_member
from mavfi_cli.core.seeds import Stream
from mavfi_cli.fi.bits import NUMPY_TYPES, Field, Scalar, draw_bits, flip

Value = TypeVar("Value", bound=Scalar | np.generic | NDArray[Any])


def inject(
    value: Value,
    *,
    bits: int = 1,
    field: str | Field = Field.ANY,
    seed: int = 1,
    exact_bits: Sequence[int] | None = None,
) -> Value:
    """Return the value with flipped bits, or a copy of the array with one corrupted element.

    The same arguments give the same flip. An injection into the result with the same seed and the
    same bits restores the value.

    Args:
        value: Python float (binary64), int (int64) or bool, a numpy scalar, or an array of any
            shape with dtype float64, float32, int64, int32, int16 or bool. It is not changed.
        field: Field of the bits: sign, exponent, mantissa or any.
        seed: Seed from which the element and the bits are drawn, 0 or more.
        exact_bits: Bits to flip instead of drawn ones; bit 0 is the least significant.

    Raises:
        FaultSpecError: The type of the value is not supported, or the array is empty.
        UnknownName: No field has this name.
        FaultError: The type lacks the field or a bit of `exact_bits`, or the field has too few
            bits.
    """
    corrupted: NDArray[Any] = np.array(value)
    kind = NUMPY_TYPES.get(corrupted.dtype.name)
    if kind is None:
        known = ", ".join(NUMPY_TYPES)
        raise FaultSpecError(f"cannot flip bits of {corrupted.dtype.name}; types are {known}")
    if corrupted.size == 0:
        raise FaultSpecError("cannot flip bits of an array without elements")
    rng = Stream.FAULT.generator(seed, "value")
    element = int(rng.integers(corrupted.size))
    chosen = exact_bits
    if chosen is None:
        chosen = draw_bits(rng, kind, field=named_member(Field, "field", field), count=bits)
    corrupted.flat[element] = flip(corrupted.flat[element].item(), chosen, kind)
    if isinstance(value, np.ndarray):
        return cast(Value, corrupted)
    return cast(Value, corrupted[()] if isinstance(value, np.generic) else corrupted.item())
