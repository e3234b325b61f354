"""Detectors by name: every one is found by its entry point in the group `mavfi.detectors`."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path

from mavfi_cli.core.errors import UnknownName
from mavfi_cli.detect.base import Detector, Factory

ENTRY_POINT_GROUP = "mavfi.detectors"


def names() -> list[str]:
    """Names of all detectors that are there, sorted."""
    return sorted({entry.name for entry in entry_points(group=ENTRY_POINT_GROUP)})


def find(name: str, *, model: Path | None = None, threshold: float | None = None) -> Detector:
    """A fresh detector of that name.

    Args:
        model: its artefact; None takes the shipped one.
        threshold: replaces the model's own; the number of sigmas for `gad`.

    Raises:
        UnknownName: there is none; names the nearest.
        ModelError: an artefact that cannot be used.
        ConfigError: a threshold out of range.
    """
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            factory: Factory = entry.load()
            return factory(model=model, threshold=threshold)
    raise UnknownName("detector", name, names())
