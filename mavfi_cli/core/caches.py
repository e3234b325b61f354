"""Chooses the folders in which numba keeps machine code and matplotlib its list of fonts."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path

from mavfi_cli.core.files import PACKAGE, can_write


@cache
def choose_caches() -> None:
    """Choose other caches where the defaults cannot be written, as in another user's installation.

    Machine code stays beside the sources if they are writable. Otherwise it goes to
    XDG_CACHE_HOME/mavfi, or else to a private folder for temporary files, which a line on stderr
    names when it is made. Child processes inherit the choice through NUMBA_CACHE_DIR and
    MPLCONFIGDIR. Writable folders that the user chose by these variables stay.
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
    """A folder of the user as the XDG specification defines it; relative if there is no home."""
    given = Path(os.environ.get(variable, ""))
    return given if given.is_absolute() else Path(os.path.expanduser("~"), name)


def _folder() -> Path:
    """The folder for both caches: the first that can be written."""
    home = _home("XDG_CACHE_HOME", ".cache") / "mavfi"
    if home.is_absolute() and can_write(home):
        return home
    folder = Path(tempfile.gettempdir(), f"mavfi-{os.getuid()}")
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        found = folder.lstat()
        if (found.st_uid, found.st_mode) == (os.getuid(), stat.S_IFDIR | 0o700):
            return folder
        folder = Path(tempfile.mkdtemp(prefix="mavfi-"))  # machine code of others must not run here
    sys.stderr.write(
        f"caches are in {folder}: neither {PACKAGE} nor {home} can be written; XDG_CACHE_HOME "
        "names another folder\n"
    )
    return folder
