"""Compiles Python functions with numba and caches them on disk. Imports numba on first use.

The code targets x86-64-v3 on every processor that supports it, so an instruction-level fault
strikes the same instruction on a processor with AVX-512 and on one without.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import os
import stat
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])
PACKAGE = Path(__file__).parents[1]
_BLAS = "scipy.linalg.cython_blas"
_LEVELS = {  # features that each level of x86-64 adds, in Linux's names: System V ABI, 3.1.1
    "x86-64-v2": "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3",
    "x86-64-v3": "abm avx avx2 bmi1 bmi2 f16c fma movbe xsave",
    "x86-64-v4": "avx512f avx512bw avx512cd avx512dq avx512vl",
}
TARGET = "x86-64-v3"
"""Level of x86-64 that kernels are compiled for."""


def compiled(function: F, *, releases_gil: bool = False) -> F:
    """Return a version of `function` that numba compiles when it is first called.

    The machine code is cached on disk. It uses IEEE arithmetic without reordering, and no threads.

    numba's cache checks the source file of a function, but not the files of the functions that
    were compiled into it. Here the stamp of a cache entry covers all sources in the folder of the
    function and in those of all compiled functions that it can reach. Outdated code is never run.

    Args:
        releases_gil: Let other threads run Python code during a call from Python.
    """
    numba = _numba()
    dispatcher = numba.njit(cache=True, error_model="numpy", nogil=releases_gil)(function)
    cache = getattr(dispatcher, "_cache", None)
    cache_file = getattr(cache, "_cache_file", None)
    if cache_file is not None:
        _load_without_compiler(cache)
        folders = sorted({Path(inspect.getfile(reached)).parent for reached in _reached(function)})
        cache_file._source_stamp = tuple(folder_digest(folder) for folder in folders)
    kernel: F = dispatcher
    return kernel


@functools.cache
def processor_level() -> str:
    """Return this processor's level of x86-64, such as "x86-64-v3", or "" if it is unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    flags = next((line.split(":")[1].split() for line in lines if line.startswith("flags")), [])
    level = "x86-64" if "lm" in flags else ""
    for name, added in _LEVELS.items():
        if not level or not {*added.split()} <= {*flags}:
            break
        level = name
    return level


def in_cache(kernel: Callable[..., Any]) -> bool:
    """Return True if a call of a compiled function would not have to compile it.

    This is the case if its machine code is in the cache on disk, or if compilation is disabled
    (NUMBA_DISABLE_JIT).
    """
    cache_file = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    try:
        return cache_file is None or bool(cache_file._load_index())
    except Exception:  # a damaged file can raise any error
        return False


def _load_without_compiler(cache: Any) -> None:
    """Let numba load cached machine code without its compiler, and recompile damaged cache entries.

    Otherwise numba would load its whole compiler, which takes 0.4 s, before it checks the cache.
    Machine code needs only the runtime. If something is compiled, the compiler loads what it needs.
    """
    from numba.core.runtime import rtsys

    def load_overload(signature: Any, context: Any) -> Any:
        try:
            rtsys.initialize(context)
            return cache._load_overload(signature, context)
        except Exception:  # a damaged file can raise any error
            with contextlib.suppress(OSError):
                cache._cache_file.flush()
            return None

    cache.load_overload = load_overload


def _numba() -> Any:
    """Import numba and return it. Do not load BLAS: it takes 0.14 s, and no kernel uses it."""
    choose_caches()  # before numba reads the environment
    import numba

    if "NUMBA_CPU_NAME" not in os.environ and processor_level() >= TARGET:
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = TARGET, ""
    if "numba.np.arraymath" not in sys.modules and _BLAS not in sys.modules:
        sys.modules[_BLAS] = None  # type: ignore[assignment]  # makes its import fail
        try:
            import numba.np.arraymath
        finally:
            del sys.modules[_BLAS]
    return numba


def _reached(function: Any) -> list[Any]:
    """Return the function and the Python function behind each compiled function that it can reach.

    It can reach those that its module defines or imports, and what they can reach in turn.
    """
    reached = [function]
    for known in reached:
        others = (getattr(value, "py_func", None) for value in known.__globals__.values())
        reached += [other for other in others if other is not None and other not in reached]
    return reached


# Sources ------------------------------------------------------------------------------------------


@functools.cache
def folder_digest(folder: Path, *, deep: bool = False) -> str:
    """Return the SHA-256 of the names and contents of all Python files in a folder, in hexadecimal.

    Args:
        deep: also include the files in subfolders, and all TOML files: worlds, vehicles, stacks,
            platforms and others.
    """
    digest = hashlib.sha256()
    paths = [*folder.rglob("*.py"), *folder.rglob("*.toml")] if deep else folder.glob("*.py")
    for path in sorted(paths):
        digest.update(str(path.relative_to(folder)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def own_digest() -> str:
    """Return the SHA-256 of all Python and TOML files of mavfi and of the simulated vehicle.

    The digest is in hexadecimal.
    """
    parts = [folder_digest(folder, deep=True) for folder in (PACKAGE, PACKAGE.parent / "sitl")]
    return hashlib.sha256("".join(parts).encode()).hexdigest()


# Folders of caches --------------------------------------------------------------------------------


@functools.cache
def choose_caches() -> None:
    """Choose cache folders for numba and matplotlib if the default ones are not writable.

    Machine code stays next to the sources if their folder is writable. Otherwise it goes to
    XDG_CACHE_HOME/mavfi, or else to a private temporary folder, whose path is printed to stderr
    when it is created. Child processes inherit the choice through NUMBA_CACHE_DIR and
    MPLCONFIGDIR. Writable folders that the user chose with these variables are kept.
    """
    beside = PACKAGE / "core" / "__pycache__"
    if not (can_write(Path(os.environ.get("NUMBA_CACHE_DIR") or beside)) or can_write(beside)):
        os.environ["NUMBA_CACHE_DIR"] = str(_folder())
        if (numba := sys.modules.get("numba")) is not None:  # it has read the environment
            numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]
    own = os.environ.get("MPLCONFIGDIR")
    homes = _home("XDG_CONFIG_HOME", ".config"), _home("XDG_CACHE_HOME", ".cache")
    if not all(map(can_write, [Path(own)] if own else [home / "matplotlib" for home in homes])):
        os.environ["MPLCONFIGDIR"] = str(_folder() / "matplotlib")


def _home(variable: str, name: str) -> Path:
    """Return the folder in an XDG environment variable, or the folder `name` in the user's home.

    The path is relative if the user's home is unknown.
    """
    given = Path(os.environ.get(variable, ""))
    return given if given.is_absolute() else Path(os.path.expanduser("~"), name)


def _folder() -> Path:
    """Return the folder for the caches of numba and matplotlib.

    It is XDG_CACHE_HOME/mavfi if that is writable, otherwise a private temporary folder.
    """
    home = _home("XDG_CACHE_HOME", ".cache") / "mavfi"
    if home.is_absolute() and can_write(home):
        return home
    folder = Path(tempfile.gettempdir(), f"mavfi-{os.getuid()}")
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        status = folder.lstat()
        if (status.st_uid, status.st_mode) == (os.getuid(), stat.S_IFDIR | 0o700):
            return folder
        folder = Path(
            tempfile.mkdtemp(prefix="mavfi-")
        )  # machine code of other users must not run here
    sys.stderr.write(
        f"caches are in {folder}: neither {PACKAGE} nor {home} is writable; set XDG_CACHE_HOME "
        "to choose another folder\n"
    )
    return folder


def can_write(folder: Path) -> bool:
    """Return True if files can be created in the folder, which need not exist yet."""
    place = folder.absolute()
    while place != place.parent and not os.path.lexists(place):
        place = place.parent
    return place.is_dir() and os.access(place, os.W_OK | os.X_OK)
