"""The tables of a mission, as Parquet: trace, plans, and the timetable of the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import read_parquet, write_parquet
from mavfi_cli.core.types import (
    BY_NAME,
    STATES,
    WAYPOINT_FIELDS,
    CollisionReport,
    Command,
    DType,
    FloatArray,
    Invocation,
    Message,
    Reaction,
    State,
    Trajectory,
    VehicleState,
)

if TYPE_CHECKING:
    import pyarrow as pa

_STATE_COLUMNS = ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps", "yaw_rad")
_TRUTH_COLUMNS = {
    "position_enu_m": ("truth_x_m", "truth_y_m", "truth_z_m"),
    "velocity_enu_mps": ("truth_vx_mps", "truth_vy_mps", "truth_vz_mps"),
    "clearance_m": ("truth_clearance_m",),
    "power_regression_w": ("power_regression_w",),
    "power_propeller_w": ("power_propeller_w",),
}
_GAP_MS = 100.0  # longest interpolated interval of rows; its error is 6 mm at 5 m/s^2
_GROUPS: dict[type, tuple[State, ...]] = {
    kind: tuple(state for state in STATES if state.message is kind)
    for kind in (CollisionReport, Trajectory, Command)
}


class Trace:
    """Collects rows in memory, about 200 bytes per tick or 36 MB per hour of flight."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._phases: list[str] = []
        self._vehicle: list[tuple[float, ...]] = []
        self._messages: dict[type, list[tuple[Message, int] | None]] = {k: [] for k in _GROUPS}

    def add(
        self,
        stamp_s: float,
        phase: str,
        state: VehicleState,
        report: CollisionReport | None,
        trajectory: tuple[Trajectory, int] | None,
        command: Command | None,
    ) -> None:
        """Add a tick: the companion's inputs and decisions."""
        self._stamps.append(stamp_s)
        self._phases.append(phase)
        self._vehicle.append(
            (*state.position_enu_m.tolist(), *state.velocity_enu_mps.tolist(), state.yaw_rad)
        )
        self._messages[CollisionReport].append(None if report is None else (report, 0))
        self._messages[Trajectory].append(trajectory)
        self._messages[Command].append(None if command is None else (command, 0))

    def __len__(self) -> int:
        return len(self._stamps)

    def motion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return received stamps (n,) s, positions (n, 3) m and velocities (n, 3) m/s, ENU."""
        vehicle = np.array(self._vehicle, dtype=np.float64).reshape(-1, len(_STATE_COLUMNS))
        return np.array(self._stamps), vehicle[:, 0:3], vehicle[:, 3:6]

    def table(self, truth: dict[str, np.ndarray] | None) -> pa.Table:
        """Return a table of stamp, phase, vehicle, monitored states and the referee's truth.

        The stamps of report and trajectory and the index of the waypoint identify the messages of
        the states. A state is null before its first message. Truth is joined by stamp; between the
        referee's rows, where only foreign autopilots have stamps, it is interpolated.
        """
        import pyarrow as pa

        columns: dict[str, pa.Array] = {
            "stamp_s": pa.array(self._stamps, pa.float64()),
            "phase": pa.array(self._phases, pa.string()),
        }
        vehicle = np.array(self._vehicle, dtype=np.float64).reshape(-1, len(_STATE_COLUMNS))
        for column, name in enumerate(_STATE_COLUMNS):
            columns[name] = pa.array(vehicle[:, column])
        kinds = {DType.FLOAT64: pa.float64(), DType.INT32: pa.int32(), DType.BOOL: pa.bool_()}
        for name, state in BY_NAME.items():
            values = [
                None if entry is None else state.read(*entry)
                for entry in self._messages[state.message]
            ]
            columns[name] = pa.array(values, kinds[state.dtype])
        for name, kind in (("report", CollisionReport), ("trajectory", Trajectory)):
            stamps = [entry and entry[0].stamp_s for entry in self._messages[kind]]
            columns[f"{name}_stamp_s"] = pa.array(stamps, pa.float64())
        places = [entry and entry[1] for entry in self._messages[Trajectory]]
        columns["waypoint_index"] = pa.array(places, pa.int32())
        if truth is not None:
            columns.update(self._truth_columns(truth))
        return pa.table(columns)

    def _truth_columns(self, truth: dict[str, np.ndarray]) -> dict[str, pa.Array]:
        import pyarrow as pa

        stamps_ms = np.round(np.array(self._stamps) * 1e3)
        logged_ms = np.round(truth["stamp_s"] * 1e3)
        after = np.searchsorted(logged_ms, stamps_ms)
        known = (after < len(logged_ms)) & (stamps_ms >= logged_ms[0])
        after = np.minimum(after, len(logged_ms) - 1)
        before = np.maximum(np.where(logged_ms[after] == stamps_ms, after, after - 1), 0)
        spans_ms = logged_ms[after] - logged_ms[before]
        known &= spans_ms <= _GAP_MS
        shares = (stamps_ms - logged_ms[before]) / np.maximum(spans_ms, 1.0)
        columns = {}
        for source, names in _TRUTH_COLUMNS.items():
            values = truth[source].reshape(len(logged_ms), -1)
            for column, name in enumerate(names):
                taken = _between(values[before, column], values[after, column], shares)
                columns[name] = pa.array(np.where(known, taken, np.nan), mask=~known)
        return columns


def _between(before: FloatArray, after: FloatArray, shares: FloatArray) -> FloatArray:
    """Interpolate linearly; a value at share 0 stays as it is, also if it is infinite."""
    with np.errstate(invalid="ignore"):
        mixed: FloatArray = np.where(shares == 0.0, before, before + shares * (after - before))
    return mixed


# Plans: one row per waypoint ----------------------------------------------------------------------

_PLAN = {"stamp_s": np.float64, "trajectory_seq": np.int32, "future_collision_seq": np.int32}


def write_plans(path: Path, plans: Sequence[Trajectory]) -> None:
    """Write all plans of a mission, as received by the mission logic."""
    import pyarrow as pa

    lengths = [len(plan.waypoints) for plan in plans]
    columns: dict[str, pa.Array] = {
        "plan": np.repeat(np.arange(len(plans), dtype=np.int32), lengths)
    }
    for name, kind in _PLAN.items():
        columns[name] = np.repeat(np.array([getattr(plan, name) for plan in plans], kind), lengths)
    waypoints = [plan.waypoints for plan in plans] or [np.zeros((0, len(WAYPOINT_FIELDS)))]
    for place, name in enumerate(WAYPOINT_FIELDS):
        columns[name] = np.concatenate([each[:, place] for each in waypoints])
    columns["duration_s"] = np.concatenate([plan.durations_s for plan in plans] or [np.zeros(0)])
    write_parquet(path, pa.table(columns))


def read_plans(path: Path) -> list[Trajectory]:
    """Read plans. The file does not contain plans without waypoints.

    Raises:
        RecordError: The file is missing, damaged, or of another format.
    """
    columns = _columns(path, "plans", ("plan", *_PLAN, *WAYPOINT_FIELDS, "duration_s"))
    plans = []
    for number in np.unique(columns["plan"]):
        rows = columns["plan"] == number
        first = int(np.argmax(rows))
        plans.append(
            Trajectory(
                waypoints=np.column_stack([columns[name][rows] for name in WAYPOINT_FIELDS]),
                durations_s=columns["duration_s"][rows],
                **{name: columns[name][first].item() for name in _PLAN},
            )
        )
    return plans


# Timetable: one row per invocation or reaction ----------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Timetable:
    """Timetable of one mission.

    Attributes:
        invocations: Invocations in the order of their starts. An output takes effect at the end,
            unless the node died or was killed.
    """

    invocations: Sequence[Invocation] = ()
    reactions: Sequence[Reaction] = ()


_RESPONSE = "response"  # rows of reactions, from the frame's stamp to the setpoint's


def write_timetable(path: Path, timetable: Timetable) -> None:
    """Write a timetable with the columns `kernel`, `start_s` and `end_s`."""
    import pyarrow as pa

    rows = [(each.node, each.start_s, each.end_s) for each in timetable.invocations]
    rows += [(_RESPONSE, r.frame_stamp_s, r.setpoint_stamp_s) for r in timetable.reactions]
    kinds = {"kernel": pa.string(), "start_s": pa.float64(), "end_s": pa.float64()}
    columns = {
        name: pa.array([row[place] for row in rows], kind)
        for place, (name, kind) in enumerate(kinds.items())
    }
    write_parquet(path, pa.table(columns))


def read_timetable(path: Path) -> Timetable:
    """Read a timetable.

    Raises:
        RecordError: The file is missing, damaged, or of another format.
    """
    columns = _columns(path, "time table", ("kernel", "start_s", "end_s"))
    rows = list(zip(*(column.tolist() for column in columns.values()), strict=True))
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


def _columns(path: Path, what: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    table = read_parquet(path, what)
    try:
        return {name: table[name].to_numpy() for name in names}
    except KeyError as error:
        raise RecordError(f"{path}: no {what} can be read ({error})") from None
