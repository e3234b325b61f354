"""The one way in which control code is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """`function` as cached machine code; IEEE arithmetic without reordering, so it repeats."""
    return cast(F, numba.njit(cache=True, error_model="numpy")(function))
