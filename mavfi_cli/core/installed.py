"""Finds the installed versions of mavfi and its libraries, and loads plug-ins."""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Mapping, Sequence
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from mavfi_cli.core.errors import MavfiError, UnknownName, described

try:
    __version__ = importlib.metadata.version("mavfi")
except importlib.metadata.PackageNotFoundError:  # a source tree without an installation
    __version__ = "0+unknown"
_LIBRARIES = ("numpy", "numba", "jsbsim", "pymavlink", "pyoctomap", "ompl", "python-fcl")


def installed_versions() -> dict[str, str]:
    """Return the version of mavfi, of Python and of each library that can affect a record.

    The versions are keyed by name.
    """
    own = {"mavfi": __version__, "python": sys.version.split()[0]}
    return own | {name: importlib.metadata.version(name) for name in _LIBRARIES}


def version_differences(recorded: Mapping[str, str], versions: Mapping[str, str]) -> list[str]:
    """Return one phrase for each program or library whose version differs from the recorded one.

    Args:
        recorded: Versions in a record, keyed by name.
        versions: Versions of this installation, keyed by name.
    """
    return [
        f"{name} was {recorded.get(name, 'absent')}, is {versions.get(name, 'absent')}"
        for name in sorted({*recorded, *versions})
        if recorded.get(name) != versions.get(name)
    ]


class PlugIns:
    """The plug-ins of one kind: objects that packages register in an entry-point group.

    Args:
        group: Name of the entry-point group.
        kind: Noun for a plug-in of this kind, for error messages.
        ours: Names of mavfi's own objects of this kind, which need no entry point.
    """

    def __init__(self, group: str, kind: str, ours: Sequence[str] = ()) -> None:
        self.group, self._kind, self._ours = group, kind, ours

    @cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        """The entry points of the group, keyed by name.

        The first use reads the metadata of all installed packages.
        """
        return {entry.name: entry for entry in reversed([*entry_points(group=self.group)])}

    @property
    def names(self) -> list[str]:
        """The names of mavfi's own objects, followed by those of plug-ins in alphabetical order."""
        return [*self._ours, *sorted(self._entries.keys() - set(self._ours))]

    def load(self, name: str) -> Any:
        """Import and return the object that is registered under a name.

        Raises:
            UnknownName: No entry point of the group has this name. The message suggests the nearest
                name.
            MavfiError: The module of the object cannot be imported, or lacks the object.
        """
        if name not in self._entries:
            raise UnknownName(self._kind, name, self.names)
        entry = self._entries[name]
        try:
            return entry.load()
        except Exception as error:  # code of another package may raise anything
            raise MavfiError(
                f"the plug-in {name!r} ({entry.value}) cannot be loaded: {described(error)}"
            ) from None
