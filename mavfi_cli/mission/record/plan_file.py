"""Writes and reads plans.parquet: all plans of a mission, as received by the mission logic."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_atomically
from mavfi_cli.core.types import WAYPOINT_FIELDS, Trajectory

_COLUMNS = ("stamp_s", "trajectory_seq", "future_collision_seq", *WAYPOINT_FIELDS, "duration_s")


def write_plans(path: Path, plans: Sequence[Trajectory]) -> None:
    """Write plans as Parquet, atomically, one row per waypoint. Equal plans give equal bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    lengths = [len(plan.waypoints) for plan in plans]
    columns: dict[str, pa.Array] = {
        "plan": np.repeat(np.arange(len(plans), dtype=np.int32), lengths)
    }
    for name, kind in (
        ("stamp_s", np.float64),
        ("trajectory_seq", np.int32),
        ("future_collision_seq", np.int32),
    ):
        columns[name] = np.repeat(np.array([getattr(plan, name) for plan in plans], kind), lengths)
    waypoints = [plan.waypoints for plan in plans] or [np.zeros((0, len(WAYPOINT_FIELDS)))]
    for place, name in enumerate(WAYPOINT_FIELDS):
        columns[name] = np.concatenate([each[:, place] for each in waypoints])
    columns["duration_s"] = np.concatenate([plan.durations_s for plan in plans] or [np.zeros(0)])
    table = pa.table(columns)
    write_atomically(path, lambda file: pq.write_table(table, file, compression="zstd"))


def read_plans(path: Path) -> list[Trajectory]:
    """Read plans. The file does not contain plans without waypoints.

    Raises:
        RecordError: The file is missing, damaged, or of another format.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
        columns = {name: table[name].to_numpy() for name in ("plan", *_COLUMNS)}
    except (OSError, KeyError, pa.ArrowException) as error:
        raise RecordError(f"{path}: no plans can be read ({error})") from None
    plans = []
    for number in np.unique(columns["plan"]):
        rows = columns["plan"] == number
        first = int(np.argmax(rows))
        plans.append(
            Trajectory(
                stamp_s=float(columns["stamp_s"][first]),
                waypoints=np.column_stack([columns[name][rows] for name in WAYPOINT_FIELDS]),
                durations_s=columns["duration_s"][rows],
                trajectory_seq=int(columns["trajectory_seq"][first]),
                future_collision_seq=int(columns["future_collision_seq"][first]),
            )
        )
    return plans
