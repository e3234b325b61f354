"""Repeats a run from its record and finds the first difference between two runs."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import file_digest
from mavfi_cli.core.types import BY_NAME
from mavfi_cli.mission.record.run_folder import Run
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import measured_factor

HOST_SECTION = "host"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Parting:
    """First value in which two runs differ."""

    stamp_s: float
    column: str
    this: Any
    other: Any


def config_of(run: Run, *, with_fault: bool = True) -> MissionConfig:
    """Return the configuration of a run, or of its golden run if `with_fault` is False.

    The golden run has no detector either, because it is the reference for fault and detection.

    Raises:
        RecordError: The run is not repeatable, because it flew a foreign autopilot, used measured
            times, was interrupted by the user, or named a file that has changed since.
    """
    values = dict(run.record.config)
    if run.record.interrupted:
        raise RecordError(f"{run.folder.path}: an interrupted flight does not repeat")
    if values.get("link") is not None:
        raise RecordError(f"{run.folder.path}: a flight of a foreign autopilot does not repeat")
    if measured_factor(values.get("platform", "")) is not None:
        raise RecordError(f"{run.folder.path}: a flight on measured kernel times does not repeat")
    for name, digest in run.record.files.items():
        if file_digest(name) != digest:
            how = "has changed since this flight" if Path(name).exists() else "does not exist"
            raise RecordError(f"{run.folder.path}: {name} {how}, so the flight does not repeat")
    config = structure(values, MissionConfig, path=run.folder.result)
    return config if with_fault else config.golden


def differing_results(this: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return the sections in which two results differ, except the host's."""
    keys = sorted({*this, *other} - {HOST_SECTION})
    return [key for key in keys if this.get(key) != other.get(key)]


def first_difference(
    this: Run, other: Run, *, truth: bool = False, leave_out: Collection[str] = ()
) -> _Parting | None:
    """Find the first difference between the traces of two runs; None if they are equal.

    Within a tick the columns are compared in the order of the pipeline: perception, planning,
    control, then the vehicle. The referee's truth is ignored by default. Columns in `leave_out` are
    ignored, too, and those that one run lacks.

    Raises:
        RecordError: A run has no trace.
    """
    if this.trace is None or other.trace is None:
        raise RecordError(f"{(this if this.trace is None else other).folder.path}: no trace")
    names = [name for name in this.trace.column_names if name in other.trace.column_names]
    columns = [name for name in BY_NAME if name in names]
    columns += [name for name in names if name not in BY_NAME and name != "stamp_s"]
    if not truth:
        columns = [c for c in columns if not c.startswith(("truth_", "power_"))]
    stamps = this.trace["stamp_s"]
    rows = limit = min(this.trace.num_rows, other.trace.num_rows)
    found: _Parting | None = None
    for column in (c for c in columns if c not in leave_out):
        pair = (run.slice(0, limit)[column].to_pylist() for run in (this.trace, other.trace))
        for row, (a, b) in enumerate(zip(*pair, strict=True)):
            if not _same(a, b):
                found = _Parting(stamp_s=stamps[row].as_py(), column=column, this=a, other=b)
                limit = row
                break
    if found is not None:
        return found
    ends = (
        ("outcome", this.record.outcome, other.record.outcome),
        ("ticks", this.trace.num_rows, other.trace.num_rows),
    )
    stamp_s = stamps[rows - 1].as_py() if rows else 0.0
    for column, a, b in ends:
        if a != b:
            return _Parting(stamp_s=stamp_s, column=column, this=a, other=b)
    return None


def _same(a: Any, b: Any) -> bool:
    return bool(a == b) or (isinstance(a, float) and isinstance(b, float) and a != a and b != b)


def largest_deviation_m(this: Run, other: Run) -> float:
    """Return the largest distance between two vehicles at equal stamps, m; NaN without a trace.

    A vehicle whose flight has ended stays where it is.
    """
    if not (this.trace and other.trace):
        return float("nan")
    rows = max(this.trace.num_rows, other.trace.num_rows)
    places = []
    for trace in (this.trace, other.trace):
        place = np.column_stack([trace[name].to_numpy() for name in ("x_m", "y_m", "z_m")])
        places.append(np.pad(place, ((0, rows - len(place)), (0, 0)), mode="edge"))
    return float(np.linalg.norm(places[0] - places[1], axis=1).max(initial=0.0))
