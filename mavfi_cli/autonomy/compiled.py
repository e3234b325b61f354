"""The one door to numba: a typed decorator for native kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(function: Kernel) -> Kernel:
    """The function as machine code, cached on disk; strict IEEE arithmetic, no threads."""
    kernel: Kernel = numba.njit(cache=True, error_model="numpy")(function)
    return kernel
