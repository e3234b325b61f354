"""The one way in which control and vehicle code is compiled."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """`function` as cached machine code; IEEE arithmetic without reordering, so it repeats.

    numba's cache knows the file of a function, but not the files of the functions and constants
    that were compiled into it. Here the stamp of a cache entry covers all sources of the
    function's folder and of this one, so code from before an edit or an upgrade is never run.
    """
    dispatcher = numba.njit(cache=True, error_model="numpy")(function)
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None:
        folder = Path(inspect.getfile(function)).parent
        cache_file._source_stamp = (_sources_digest(folder), _sources_digest(_HERE))
    return cast(F, dispatcher)


_HERE = Path(__file__).parent


@cache
def _sources_digest(folder: Path) -> str:
    """SHA-256 of all Python sources of a folder, by name and content."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
