"""The detectors that are there, each with its model file and where that came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import ModelError
from mavfi_cli.detect import model as model_file
from mavfi_cli.detect.registry import find, names


def listing(models: Path | None = None) -> list[dict[str, Any]]:
    """A row a model: detector, file, stack, threshold, provenance, and a line about it.

    A detector without a model has one row. One that cannot be used is told with the reason instead
    of its threshold.

    Args:
        models: folder of model files `NAME.json`; None takes those that are shipped.
    """
    return [_row(name, path) for name in names() for path in _paths(name, models)]


def _paths(name: str, models: Path | None) -> list[Path | None]:
    """The model files of a detector; None stands for none."""
    if models is not None:
        return [models / f"{name}.json"]
    shipped = [model_file.shipped(name, stack) for stack in model_file.shipped_stacks()]
    return [path for path in shipped if path.is_file()] or [None]


def _row(name: str, path: Path | None) -> dict[str, Any]:
    has_model = path is not None and path.is_file()
    row: dict[str, Any] = {
        "name": name,
        "model": str(path) if has_model else None,
        "stack": None,
        "threshold": None,
        "provenance": None,
    }
    try:
        row["threshold"] = find(name, model=path).threshold
        if path is not None:
            row["provenance"] = model_file.provenance(path)
            row["stack"] = row["provenance"].pop("stack")["name"]
    except ModelError as error:
        return {**row, "told": f"cannot be used: {error}"}
    return {**row, "told": _told(row["provenance"])}


def _told(provenance: dict[str, Any] | None) -> str:
    if provenance is None:
        return "needs no training"
    flights = training_flights(provenance)
    seeds = sorted({int(end) for f in flights if (end := f.rpartition("/")[2]).isdigit()})
    span = f", seeds {seeds[0]} to {seeds[-1]}" if seeds else ""
    return (
        f"{provenance.get('flights', len(flights))} flights in "
        f"{', '.join(provenance.get('worlds', [])) or 'unknown worlds'}{span}; "
        f"mavfi {provenance['mavfi']}"
    )


def training_flights(provenance: Mapping[str, Any]) -> Sequence[str]:
    """Flights `world/seed` that a model has seen, of all parts of its split."""
    parts = provenance.get("split", {})
    if not isinstance(parts, Mapping):
        return []
    return [str(flight) for part in parts.values() for flight in part]
