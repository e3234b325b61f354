"""What is installed: mavfi, the libraries that a record depends on, and plug-ins.

A plug-in is what another package registers under an entry point.
"""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoints, entry_points
from typing import Any

from mavfi_cli.core.errors import MavfiError, UnknownName, described

try:
    __version__ = importlib.metadata.version("mavfi")
except importlib.metadata.PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
_LIBRARIES = ("numpy", "numba", "jsbsim", "pymavlink", "pyoctomap", "ompl", "python-fcl")


def installed_versions() -> dict[str, str]:
    """Return the versions of all libraries that a record depends on."""
    versions = {"mavfi": __version__, "python": sys.version.split()[0]}
    for name in _LIBRARIES:
        versions[name] = importlib.metadata.version(name)
    return versions


def version_differences(recorded: Mapping[str, str], versions: Mapping[str, str]) -> list[str]:
    """Describe each library that differs between a record and this installation."""
    return [
        f"{name} was {recorded.get(name, 'absent')}, is {versions.get(name, 'absent')}"
        for name in sorted({*recorded, *versions})
        if recorded.get(name) != versions.get(name)
    ]


@cache
def installed(group: str) -> EntryPoints:
    """Return the entry points of a group. To find them reads the metadata of all packages."""
    return entry_points(group=group)


def load_plug_in(group: str, kind: str, name: str, known: list[str]) -> Any:
    """Return what a plug-in's entry point names.

    Raises:
        UnknownName: No plug-in has this name. Suggests the nearest.
        MavfiError: Its module cannot be imported, or lacks the object.
    """
    for entry in installed(group):
        if entry.name == name:
            try:
                return entry.load()
            except Exception as error:  # another package's code may raise anything
                raise MavfiError(
                    f"the plug-in {name!r} ({entry.value}) does not load: {described(error)}"
                ) from None
    raise UnknownName(kind, name, known)
