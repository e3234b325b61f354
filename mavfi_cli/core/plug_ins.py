"""Plug-ins: what other packages register under an entry point."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoints, entry_points
from typing import Any

from mavfi_cli.core.errors import MavfiError, UnknownName


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
                found = f"{type(error).__name__}: {error}"
                raise MavfiError(
                    f"the plug-in {name!r} ({entry.value}) does not load: {found}"
                ) from None
    raise UnknownName(kind, name, known)
