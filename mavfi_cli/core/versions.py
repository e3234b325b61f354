"""Versions of mavfi and of the libraries that a record depends on."""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Mapping

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
