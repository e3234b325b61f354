"""Registry of detectors, found by their entry points in the group `mavfi.detectors`."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path

from mavfi_cli.core.errors import UnknownName
from mavfi_cli.detect.base import Detector, Factory

ENTRY_POINT_GROUP = "mavfi.detectors"


@cache
def _installed() -> EntryPoints:
    """Return the entry points of detectors. To find them reads the metadata of all packages."""
    return entry_points(group=ENTRY_POINT_GROUP)


def names() -> list[str]:
    """Return the names of all installed detectors, sorted."""
    return sorted(_installed().names)


def find(name: str, *, model: Path | None = None, threshold: float | None = None) -> Detector:
    """Create a new detector of that name.

    Args:
        model: Model file; None selects the shipped one.
        threshold: Replaces the model's threshold; a number of sigmas for `gad`.

    Raises:
        UnknownName: No detector has this name. Suggests the nearest.
        ModelError: The model file cannot be used.
        ConfigError: The threshold is out of range.
    """
    for entry in _installed():
        if entry.name == name:
            factory: Factory = entry.load()
            return factory(model=model, threshold=threshold)
    raise UnknownName("detector", name, names())
