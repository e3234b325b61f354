"""The one way in which Python becomes machine code here. numba is imported on first use only."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from mavfi_cli.core.sources import folder_digest

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """`function` as machine code, cached on disk; IEEE arithmetic without reordering, no threads.

    numba's cache knows the file of a function, but not the files of the functions that were
    compiled into it. Here the stamp of a cache entry covers all sources in the folder of the
    function and in those of the compiled functions it can call, so code from before an edit or an
    upgrade is never run.
    """
    import numba

    dispatcher = numba.njit(cache=True, error_model="numpy")(function)
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None:
        known: list[Any] = [function, *_callees(function)]
        folders = sorted({Path(inspect.getfile(each)).parent for each in known})
        cache_file._source_stamp = tuple(folder_digest(folder) for folder in folders)
    kernel: F = dispatcher
    return kernel


def _callees(function: Any) -> list[Any]:
    """The Python side of every compiled function that the module of `function` has so far."""
    return [each.py_func for each in function.__globals__.values() if hasattr(each, "py_func")]
