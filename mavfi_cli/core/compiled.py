"""The one way in which Python becomes machine code here. numba is imported on first use only."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from mavfi_cli.core.sources import folder_digest

F = TypeVar("F", bound=Callable[..., Any])
_BLAS = "scipy.linalg.cython_blas"


def compiled(function: F) -> F:
    """`function` as machine code, cached on disk; IEEE arithmetic without reordering, no threads.

    numba's cache knows the file of a function, but not the files of the functions that were
    compiled into it. Here the stamp of a cache entry covers all sources in the folder of the
    function and in those of the compiled functions it can call, so code from before an edit or an
    upgrade is never run.
    """
    numba = _numba()
    dispatcher = numba.njit(cache=True, error_model="numpy")(function)
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None:
        known: list[Any] = [function, *_callees(function)]
        folders = sorted({Path(inspect.getfile(each)).parent for each in known})
        cache_file._source_stamp = tuple(folder_digest(folder) for folder in folders)
    kernel: F = dispatcher
    return kernel


def in_cache(kernel: Callable[..., Any]) -> bool:
    """Whether a compiled function has machine code on disk that a call would load.

    True as well where it is not compiled at all (NUMBA_DISABLE_JIT), for then no call takes long.
    """
    cache_file = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    return cache_file is None or bool(cache_file._load_index())


def _numba() -> Any:
    """numba, without BLAS: it would import all of scipy.linalg to look for it.

    That takes 0.14 s of processor time in every process, for nothing: no kernel here multiplies
    matrices. One that did (`@`, `np.dot`, `np.linalg`) would not compile, and says so.
    """
    import numba

    if "numba.np.arraymath" not in sys.modules and _BLAS not in sys.modules:
        sys.modules[_BLAS] = None  # type: ignore[assignment]  # an import of it fails
        try:
            import numba.np.arraymath
        finally:
            del sys.modules[_BLAS]
    return numba


def _callees(function: Any) -> list[Any]:
    """The Python side of every compiled function that the module of `function` has so far."""
    return [each.py_func for each in function.__globals__.values() if hasattr(each, "py_func")]
