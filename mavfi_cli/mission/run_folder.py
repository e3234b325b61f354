"""Reads and writes the folder of one run, and compares runs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import (
    Json,
    file_digest,
    own_folder,
    read_json,
    read_parquet,
    reading,
    write_json,
    write_parquet,
    writing,
)
from mavfi_cli.core.types import (
    BY_NAME,
    STATES,
    WAYPOINT_FIELDS,
    Briefing,
    CollisionReport,
    Command,
    DType,
    FloatArray,
    Invocation,
    Message,
    Reaction,
    Trajectory,
    VehicleState,
)
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import PlatformProfile
from mavfi_cli.spec.stack import FIRST

if TYPE_CHECKING:
    import pyarrow as pa

RESULT, FAULT, TRACE = "result.json", "fault.json", "trace.parquet"
_LARGEST_RESULT = 1 << 27  # bytes
_NEEDED = (
    "outcome", "config", "quality_of_flight", "pilot", "events", "simulated_s", "versions", "host",
)  # fmt: skip
_PLAN = {"stamp_s": np.float64, "trajectory_seq": np.int32, "future_collision_seq": np.int32}
BRIEFING = "briefing.json"
# Arrays in a briefing's file, with their lengths. The camera itself reports its field of view.
BRIEFED = {"start_enu_m": 3, "goal_enu_m": 3, "bounds_enu_m": 6, "camera_offset_flu_m": 3}
COMPANION_VARIES = "a flight of a user's companion is not repeatable"
_RESPONSE = "response"  # rows of reactions, from the frame's stamp to the setpoint's


class RunFolder:
    """The paths of the files in a run folder, and methods that write and read its tables."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.result = path / RESULT  # outcome, quality of flight, seeds, versions, configuration
        self.trace = path / TRACE  # states at every control tick
        self.plans = path / "plans.parquet"  # every waypoint of every plan
        self.kernels = path / "kernels.parquet"  # start and end of every invocation
        self.tlog = path / "flight.tlog"  # every MAVLink frame of both directions
        self.picture = path / "flight.svg"  # top view and height of the flight
        self.fault = path / FAULT  # fault record, on disk before the fault strikes
        self.crash = path / "crash.txt"  # tracebacks of the companion and of nodes
        self.programs = path / "programs"  # outputs of a user's companion, by program
        self.briefing = self.programs / BRIEFING
        self.golden = path / "golden"  # run folder of the golden run of the pair

    @classmethod
    def new(cls, parent: Path, world: str, seed: int) -> RunFolder:
        """Create an empty run folder in `parent`, named `<world>-<seed>-<number>`.

        The number makes the name unique, even if several missions create folders at the same time.
        Characters of the world's name that are unfit for paths are replaced by "-".

        Raises:
            RecordError: The folder cannot be created.
        """
        name = world.removesuffix(".toml").rpartition("/")[2]
        name = "".join(c if c.isalnum() or c in "-_." else "-" for c in name) or "world"
        stem = f"{name}-{seed}"
        with writing(parent):
            parent.mkdir(parents=True, exist_ok=True)
            ends = (path.name.rpartition("-")[2] for path in parent.glob(f"{stem}-[0-9]*"))
            number = max((int(end) for end in ends if end.isdigit()), default=0) + 1
            while True:
                path = parent / f"{stem}-{number:03d}"
                try:
                    path.mkdir()
                    return cls(path)
                except FileExistsError:
                    number += 1
        raise AssertionError("unreachable")

    def write_briefing(self, briefing: Briefing) -> None:
        """Write the briefing to a file for the programs of a user's companion.

        Raises:
            RecordError: The file cannot be written.
        """
        own_folder(self.programs)
        write_json(self.briefing, {name: getattr(briefing, name) for name in BRIEFED})

    def write_plans(self, plans: Sequence[Trajectory]) -> None:
        """Write a table of all plans that the mission logic received, one row per waypoint."""
        import pyarrow as pa

        lengths = [len(plan.waypoints) for plan in plans]
        columns = {"plan": np.repeat(np.arange(len(plans), dtype=np.int32), lengths)}
        for name, kind in _PLAN.items():
            values = np.array([getattr(plan, name) for plan in plans], kind)
            columns[name] = np.repeat(values, lengths)
        rows = np.vstack([np.zeros((0, len(WAYPOINT_FIELDS))), *(plan.waypoints for plan in plans)])
        columns.update(zip(WAYPOINT_FIELDS, rows.T.copy(), strict=True))
        durations = [plan.durations_s for plan in plans]
        columns["duration_s"] = np.concatenate([np.zeros(0), *durations])
        write_parquet(self.plans, pa.table(columns))

    def read_plans(self) -> list[Trajectory]:
        """Read the plans from their table. Plans without waypoints, which have no row, are omitted.

        Raises:
            RecordError: The file is missing, damaged, or of another format.
        """
        names = ("plan", *_PLAN, *WAYPOINT_FIELDS, "duration_s")
        columns = _columns(self.plans, "plans", names)
        plans = []
        for number in np.unique(columns["plan"]):
            rows = columns["plan"] == number
            plans.append(
                Trajectory(
                    waypoints=np.column_stack([columns[name][rows] for name in WAYPOINT_FIELDS]),
                    durations_s=columns["duration_s"][rows],
                    **{name: columns[name][rows][0].item() for name in _PLAN},
                )
            )
        return plans

    def write_timetable(
        self, invocations: Sequence[Invocation], reactions: Sequence[Reaction]
    ) -> None:
        """Write the timetable: one row per kernel invocation, then one row per reaction.

        A row has the name of the kernel, and its start and end in seconds. The row of a reaction
        starts at the depth frame and ends at the setpoint.
        """
        import pyarrow as pa

        rows = [(run.node, run.start_s, run.end_s) for run in invocations]
        rows += [(_RESPONSE, r.frame_stamp_s, r.setpoint_stamp_s) for r in reactions]
        kinds = {"kernel": pa.string(), "start_s": pa.float64(), "end_s": pa.float64()}
        columns = {
            name: pa.array([row[place] for row in rows], kind)
            for place, (name, kind) in enumerate(kinds.items())
        }
        write_parquet(self.kernels, pa.table(columns))

    def read_timetable(self) -> tuple[list[Invocation], list[Reaction]]:
        """Read the timetable. Return the kernel invocations in order of start, and the reactions.

        An invocation's output takes effect at its end, unless the node died or was killed.

        Raises:
            RecordError: The file is missing, damaged, or of another format.
        """
        columns = _columns(self.kernels, "time table", ("kernel", "start_s", "end_s"))
        invocations, reactions = [], []
        for kernel, begun_s, end_s in zip(*(c.tolist() for c in columns.values()), strict=True):
            if kernel == _RESPONSE:
                reactions.append(Reaction(frame_stamp_s=begun_s, setpoint_stamp_s=end_s))
            else:
                invocations.append(Invocation(node=kernel, start_s=begun_s, end_s=end_s))
        return invocations, reactions


def _columns(path: Path, what: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    table = read_parquet(path, what)
    try:
        return {name: table[name].to_numpy() for name in names}
    except KeyError as error:
        raise RecordError(f"{path}: the {what} cannot be read ({error})") from None


# Trace --------------------------------------------------------------------------------------------

_STATE_COLUMNS = ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps", "yaw_rad")
_TRUTH_COLUMNS = {
    "position_enu_m": ("truth_x_m", "truth_y_m", "truth_z_m"),
    "velocity_enu_mps": ("truth_vx_mps", "truth_vy_mps", "truth_vz_mps"),
    "clearance_m": ("truth_clearance_m",),
    "power_regression_w": ("power_regression_w",),
    "power_propeller_w": ("power_propeller_w",),
}
_GAP_MS = 100.0  # longest gap between rows to interpolate; the error is 6 mm at 5 m/s^2
_KINDS: tuple[type[Message], ...] = (CollisionReport, Trajectory, Command)


class Trace:
    """Collects the trace of a flight in memory, with one row per control tick.

    A row takes about 200 bytes, so an hour of flight takes 36 MB.
    """

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._phases: list[str] = []
        self._vehicle: list[tuple[float, ...]] = []
        self._messages: dict[type, list[tuple[Message, int] | None]] = {k: [] for k in _KINDS}

    def add(
        self,
        stamp_s: float,
        phase: str,
        state: VehicleState,
        report: CollisionReport | None,
        trajectory: tuple[Trajectory, int] | None,
        command: Command | None,
    ) -> None:
        """Add the row of one control tick: the companion's inputs and decisions.

        Args:
            trajectory: The tracked trajectory with the index of its current waypoint.
        """
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

    def motion(self) -> dict[str, FloatArray]:
        """Return the motion of the vehicle as received, in arrays keyed by column name.

        The stamps have shape (n,), in seconds. The positions, in m, and the velocities, in m/s,
        have shape (n, 3), in ENU.
        """
        vehicle = np.array(self._vehicle, dtype=np.float64).reshape(-1, len(_STATE_COLUMNS))
        return {
            "stamp_s": np.array(self._stamps),
            "position_enu_m": vehicle[:, 0:3],
            "velocity_enu_mps": vehicle[:, 3:6],
        }

    def table(self, truth: Mapping[str, FloatArray] | None) -> pa.Table:
        """Return the trace as a table with one row per control tick.

        The columns are the stamp, the phase, the vehicle's state, the monitored states, and the
        referee's truth unless `truth` is None. The stamps of report and trajectory and the index of
        the waypoint identify the messages that contain the monitored states. A state is null before
        its first message. Truth is joined by stamp. Foreign autopilots also have stamps between the
        referee's rows, where truth is interpolated.
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
        distinct = {kind: _distinct(self._messages[kind]) for kind in _KINDS}
        for state in STATES:
            entries, rows = distinct[state.message]
            values = [entry and state.read(*entry) for entry in entries]
            columns[state.name] = pa.array([values[row] for row in rows], kinds[state.dtype])
        for name, kind in (("report", CollisionReport), ("trajectory", Trajectory)):
            stamps = [entry and entry[0].stamp_s for entry in self._messages[kind]]
            columns[f"{name}_stamp_s"] = pa.array(stamps, pa.float64())
        places = [entry and entry[1] for entry in self._messages[Trajectory]]
        columns["waypoint_index"] = pa.array(places, pa.int32())
        if truth is not None:
            columns.update(self._truth_columns(truth))
        return pa.table(columns)

    def _truth_columns(self, truth: Mapping[str, FloatArray]) -> dict[str, pa.Array]:
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


_Entry = tuple[Message, int] | None  # a message and the index of its waypoint


def _distinct(entries: Sequence[_Entry]) -> tuple[list[_Entry], list[int]]:
    """Return the entries without consecutive repetitions, and each row's index into that list."""
    kept: list[_Entry] = []
    rows, last = [], (0, 0)
    for entry in entries:
        known = (0, -1) if entry is None else (id(entry[0]), entry[1])
        if known != last:
            kept.append(entry)
            last = known
        rows.append(len(kept) - 1)
    return kept, rows


def _between(before: FloatArray, after: FloatArray, shares: FloatArray) -> FloatArray:
    """Interpolate linearly between `before` (share 0) and `after` (share 1).

    Where the share is 0, the result is exactly `before`, even if a value is infinite.
    """
    with np.errstate(invalid="ignore"):
        mixed: FloatArray = np.where(shares == 0.0, before, before + shares * (after - before))
    return mixed


# Reading and comparing runs -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Parting:
    """The first value in which the traces of two runs differ."""

    stamp_s: float
    column: str
    this: Any
    other: Any


@dataclass(frozen=True, slots=True)
class Run:
    """A run read from its folder.

    Attributes:
        to_html: Function that renders a run's summary and picture as HTML; set by
            `mavfi_cli.library`.
        result: Content of the run's result.json.
        trace: None if the run folder has no trace.
    """

    to_html: ClassVar[Callable[[Run], str] | None] = None
    folder: RunFolder
    result: Json
    trace: pa.Table | None

    def __repr__(self) -> str:
        return f"Run({str(self.folder.path)!r}, outcome={self.record.outcome!r})"

    def _repr_html_(self) -> str | None:
        """Return HTML for a notebook to display, or None if `mavfi_cli.library` is not loaded."""
        return None if Run.to_html is None else Run.to_html(self)

    @property
    def record(self) -> FlightRecord:
        """The sections of the run's result.json."""
        with reading(self.folder.result):
            return FlightRecord.of(self.result)

    @property
    def golden(self) -> Run | None:
        """The golden run in the run's folder, or None if it is missing or was interrupted."""
        path = self.folder.golden
        golden = load_run(path) if path.is_dir() else None
        return None if golden is None or golden.record.interrupted else golden

    def mission(self, *, with_fault: bool = True, firmware: str | None = None) -> MissionConfig:
        """Return the mission of this run, or of its golden run if `with_fault` is False.

        The golden run has no detector either, because it is the reference for fault and detection.

        Args:
            firmware: The firmware program that the run's record is allowed to name; see
                `MissionConfig.require_programs`.

        Raises:
            ConfigError: The record names another program.
            RecordError: The run is not repeatable: it used a foreign autopilot or measured
                times, was interrupted by the user, or named a file that has changed since.
        """
        record, path, why = self.record, self.folder.path, ""
        if record.interrupted:
            why = "the flight was interrupted, so it is not repeatable"
        elif record.config.get("link") is not None:
            why = "a flight of a foreign autopilot is not repeatable"
        elif record.config.get("companion") is not None:
            why = COMPANION_VARIES
        elif PlatformProfile.factor_of(record.config.get("platform", "")) is not None:
            why = "a flight on measured kernel times is not repeatable"
        if why:
            raise RecordError(f"{path}: {why}")
        config = structure(dict(record.config), MissionConfig, path=self.folder.result)
        with reading(self.folder.result):
            for name, digest in {**dict.fromkeys(config.files, ""), **record.files}.items():
                if not why and not (digest and file_digest(name) == digest):
                    changed = Path(name).exists()
                    how = "has changed since this flight" if changed else "does not exist"
                    why = f"{name} {how}, so the flight cannot be repeated"
        if why:
            raise RecordError(f"{path}: {why}")
        config.require_programs(firmware)
        return config if with_fault else config.golden

    def differing_sections(self, other: Run) -> list[str]:
        """Return the names of the result sections in which two runs differ, ignoring `host`."""
        keys = sorted({*self.result, *other.result} - {"host"})
        return [key for key in keys if self.result.get(key) != other.result.get(key)]

    def first_difference(
        self, other: Run, *, truth: bool = False, leave_out: Collection[str] = ()
    ) -> _Parting | None:
        """Return the first difference between the traces of two runs, or None if they are equal.

        If several columns first differ in the same tick, the earliest in the pipeline is returned:
        perception, planning, control, then the vehicle. If all ticks that both traces contain are
        equal, the outcomes and the numbers of ticks are compared. The referee's truth is ignored
        unless `truth` is True. Columns in `leave_out`, and columns that one run lacks, are also
        ignored.

        Raises:
            RecordError: A run has no trace.
        """
        if self.trace is None or other.trace is None:
            raise RecordError(
                f"{(self if self.trace is None else other).folder.path}: the run has no trace"
            )
        names = [name for name in self.trace.column_names if name in other.trace.column_names]
        columns = [name for name in BY_NAME if name in names]
        columns += [name for name in names if name not in BY_NAME and name != "stamp_s"]
        if not truth:
            columns = [c for c in columns if not c.startswith(("truth_", "power_"))]
        stamps = self.trace["stamp_s"]
        rows = limit = min(self.trace.num_rows, other.trace.num_rows)
        first: _Parting | None = None
        traces = (self.trace, other.trace)
        for column in (c for c in columns if c not in leave_out):
            pair = (trace.slice(0, limit)[column].to_pylist() for trace in traces)
            for row, (a, b) in enumerate(zip(*pair, strict=True)):
                if a != b and not (a != a and b != b):  # NaN equals NaN
                    first = _Parting(stamp_s=stamps[row].as_py(), column=column, this=a, other=b)
                    limit = row
                    break
        if first is not None:
            return first
        stamp_s = stamps[rows - 1].as_py() if rows else 0.0
        ends = {
            "outcome": (self.record.outcome, other.record.outcome),
            "ticks": (self.trace.num_rows, other.trace.num_rows),
        }
        for column, (a, b) in ends.items():
            if a != b:
                return _Parting(stamp_s=stamp_s, column=column, this=a, other=b)
        return None

    def largest_deviation_m(self, other: Run) -> float:
        """Return the largest distance between the vehicles of two runs in the same tick, in m.

        After the end of its flight, a vehicle keeps its last position. The distance is NaN if
        either run has no trace.
        """
        if not (self.trace and other.trace):
            return float("nan")
        rows = max(self.trace.num_rows, other.trace.num_rows)
        places = []
        for trace in (self.trace, other.trace):
            place = np.column_stack([trace[name].to_numpy() for name in ("x_m", "y_m", "z_m")])
            places.append(np.pad(place, ((0, rows - len(place)), (0, 0)), mode="edge"))
        return float(np.linalg.norm(places[0] - places[1], axis=1).max(initial=0.0))


def load_run(path: str | Path) -> Run:
    """Read a run from its folder or from the path of its result.json.

    Raises:
        RecordError: The run is missing, incomplete or damaged.
    """
    path = Path(path)
    folder = RunFolder(path.parent if path.name == RESULT else path)
    if not folder.path.is_dir():
        raise RecordError(f"{path}: no such run folder")
    if not folder.result.is_file():
        hint = "the run was cut off before its end" if folder.tlog.exists() else "not a run folder"
        raise RecordError(f"{folder.path}: {RESULT} is missing ({hint})")
    result = read_json(folder.result, _LARGEST_RESULT)
    trace = read_parquet(folder.trace, "trace") if folder.trace.is_file() else None
    if result.get("schema") != 1:
        raise RecordError(f"{folder.result}: the file was written by another version of mavfi")
    if missing := [key for key in _NEEDED if key not in result]:
        raise RecordError(f"{folder.result}: the file is damaged (missing: {', '.join(missing)})")
    # A setting that an older record lacks had its default. Without a stack, the stack was FIRST.
    with reading(folder.result):
        result["config"] = {**MissionConfig().to_dict(), "stack": FIRST, **result["config"]}
    return Run(folder, result, trace)
