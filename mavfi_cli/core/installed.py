"""What is installed: mavfi, the libraries that a record depends on, and plug-ins."""

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
except importlib.metadata.PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
_LIBRARIES = ("numpy", "numba", "jsbsim", "pymavlink", "pyoctomap", "ompl", "python-fcl")


def installed_versions() -> dict[str, str]:
    """Return the versions of all libraries that a record depends on."""
    own = {"mavfi": __version__, "python": sys.version.split()[0]}
    return own | {name: importlib.metadata.version(name) for name in _LIBRARIES}


def version_differences(recorded: Mapping[str, str], versions: Mapping[str, str]) -> list[str]:
    """Describe each library that differs between a record and this installation."""
    return [
        f"{name} was {recorded.get(name, 'absent')}, is {versions.get(name, 'absent')}"
        for name in sorted({*recorded, *versions})
        if recorded.get(name) != versions.get(name)
    ]


class PlugIns:
    """What other packages, and ours, register under an entry point.

    Args:
        group: Name of the entry point.
        kind: Word for what is registered.
        ours: Names that are known without an entry point.
    """

    def __init__(self, group: str, kind: str, ours: Sequence[str] = ()) -> None:
        self.group, self._kind, self._ours = group, kind, ours

    @cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        """The entry points by name. To find them reads the metadata of all packages."""
        return {entry.name: entry for entry in reversed([*entry_points(group=self.group)])}

    @property
    def names(self) -> list[str]:
        """Known names: ours, then the others in alphabetical order."""
        return [*self._ours, *sorted(self._entries.keys() - set(self._ours))]

    def load(self, name: str) -> Any:
        """Return what the entry point of that name names.

        Raises:
            UnknownName: No plug-in has this name. Suggests the nearest.
            MavfiError: Its module cannot be imported, or lacks the object.
        """
        if name not in self._entries:
            raise UnknownName(self._kind, name, self.names)
        entry = self._entries[name]
        try:
            return entry.load()
        except Exception as error:  # another package's code may raise anything
            raise MavfiError(
                f"the plug-in {name!r} ({entry.value}) does not load: {described(error)}"
            ) from None
