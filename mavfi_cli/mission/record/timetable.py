"""Timetable of the kernels in simulated time: kernels.parquet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mavfi_cli.companion.executor import Invocation
from mavfi_cli.companion.pipeline import Companion, Reaction
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_atomically


@dataclass(frozen=True, slots=True, kw_only=True)
class Timetable:
    """Timetable of one mission.

    Attributes:
        invocations: Invocations in the order of their starts. An output takes effect at the end,
            unless the node died or was killed.
        reactions: Responses from a depth frame to the first setpoint that depends on it.
    """

    invocations: Sequence[Invocation]
    reactions: Sequence[Reaction]


def timetable_of(companion: Companion | None) -> Timetable:
    """Return the timetable of a flight; empty without a flight."""
    if companion is None:
        return Timetable(invocations=(), reactions=())
    return Timetable(
        invocations=tuple(companion.executor.timetable), reactions=tuple(companion.reactions)
    )


def response_times(reactions: Sequence[Reaction]) -> dict[str, float | None]:
    """Return median and 95th percentile of the response time, s."""
    times = np.array([r.setpoint_stamp_s - r.frame_stamp_s for r in reactions])
    times = times[np.isfinite(times)]
    if not len(times):
        return {"median": None, "p95": None, "count": 0}
    return {
        "median": round(float(np.median(times)), 9),
        "p95": round(float(np.percentile(times, 95.0)), 9),
        "count": len(times),
    }


_RESPONSE = "response"  # rows of reactions, from the frame's stamp to the setpoint's


def write_timetable(path: Path, timetable: Timetable) -> None:
    """Write a timetable as Parquet, atomically, one row per invocation or reaction.

    The columns are `kernel`, `start_s` and `end_s`. Reactions have the kernel `response`. Equal
    timetables give equal bytes.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [(each.node, each.start_s, each.end_s) for each in timetable.invocations]
    rows += [(_RESPONSE, r.frame_stamp_s, r.setpoint_stamp_s) for r in timetable.reactions]
    table = pa.table(
        {
            "kernel": pa.array([row[0] for row in rows], pa.string()),
            "start_s": pa.array([row[1] for row in rows], pa.float64()),
            "end_s": pa.array([row[2] for row in rows], pa.float64()),
        }
    )
    write_atomically(path, lambda file: pq.write_table(table, file, compression="zstd"))


def read_timetable(path: Path) -> Timetable:
    """Read a timetable.

    Raises:
        RecordError: The file is missing, damaged, or of another format.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
        columns = [table[name].to_pylist() for name in ("kernel", "start_s", "end_s")]
    except (OSError, KeyError, pa.ArrowException) as error:
        raise RecordError(f"{path}: no time table can be read ({error})") from None
    rows = list(zip(*columns, strict=True))
    return Timetable(
        invocations=tuple(
            Invocation(node=kernel, start_s=start_s, end_s=end_s)
            for kernel, start_s, end_s in rows
            if kernel != _RESPONSE
        ),
        reactions=tuple(
            Reaction(frame_stamp_s=start_s, setpoint_stamp_s=end_s)
            for kernel, start_s, end_s in rows
            if kernel == _RESPONSE
        ),
    )
