"""The detectors that are there, each with its model file and where that came from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mavfi_cli.campaign.evaluation.plan import training_flights
from mavfi_cli.core.errors import ModelError
from mavfi_cli.detect import model as model_file
from mavfi_cli.detect.registry import find, names


def listing(models: Path | None = None) -> list[dict[str, Any]]:
    """A row a detector: name, model, threshold, provenance, and a line about it.

    A detector that cannot be used is told with the reason instead of its threshold.

    Args:
        models: folder of model files `NAME.json`; None takes those that come with the detectors.
    """
    return [_row(name, models) for name in names()]


def _row(name: str, models: Path | None) -> dict[str, Any]:
    path = model_file.shipped(name) if models is None else models / f"{name}.json"
    has_model = path.is_file()
    row: dict[str, Any] = {
        "name": name,
        "model": str(path) if has_model else None,
        "threshold": None,
        "provenance": None,
    }
    try:
        row["threshold"] = find(
            name, model=path if has_model or models is not None else None
        ).threshold
        if has_model:
            row["provenance"] = model_file.provenance(path)
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
