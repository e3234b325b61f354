"""Replays of recorded flights through the gate, and data sets of their samples.

A replay gives a detector's scores and, for error-free flights, the samples that models are fitted
to. One row of a data set is one judged message: a collision report, a control tick, or one step of
a published plan from waypoint to waypoint. Its deltas are the detector's input.

A trace maps column names to arrays with one row per control tick. It has `stamp_s` and every
monitored state by its name (NaN or masked before the first message with the state). Optional
columns `report_stamp_s`, `waypoint_index` and `trajectory_stamp_s` reveal a new message whose
values are unchanged. Without them, a message counts as new only if one of its values changes.

A trace contains only the current waypoint, but the gate also judges the active plan. A replay does
the same if it gets the published plans and the changes that a fault made to the active one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import ModelError
from mavfi_cli.core.files import read_parquet, write_parquet
from mavfi_cli.core.types import (
    BY_NAME,
    STATES,
    CollisionReport,
    Command,
    FloatArray,
    StackMark,
    Stage,
    Trajectory,
)
from mavfi_cli.detect import preprocess
from mavfi_cli.detect.base import Detector
from mavfi_cli.detect.gate import ALL_STAGES, Alarm, Gate
from mavfi_cli.detect.preprocess import COUNT, EXTENDED, NAMES, SPANS, Codes, PreprocessParams

Columns = Mapping[str, NDArray[Any]]
_WAYPOINT = [s.name for s in STATES if s.group.startswith("waypoint_") and s.unit != "s"]
_REPORT = list(NAMES[slice(*SPANS[Stage.PERCEPTION])])
_COMMAND = list(NAMES[slice(*SPANS[Stage.CONTROL])])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanStrike:
    """A change that a fault made to one value of the active plan."""

    stamp_s: float
    state: str
    waypoint: int
    before: float | int | bool
    after: float | int | bool


@dataclass(frozen=True, slots=True, kw_only=True)
class _Judgement:
    stamp_s: float
    report: CollisionReport | None  # None for a control tick
    new_waypoint: bool
    deltas: Codes  # (COUNT,)
    score: float  # highest score of the stages and of the plan's steps ahead
    alarm: Alarm | None


class _Probe:
    """Wraps a detector, and stores its highest score since the last `take_highest`.

    If the detector is None, every score is 0 and raises no alarm.
    """

    def __init__(self, detector: Detector | None) -> None:
        self._detector = detector
        self.name = "none" if detector is None else detector.name
        self.per_stage = detector is not None and detector.per_stage
        self.threshold = np.inf if detector is None else detector.threshold
        self.memory: Mapping[str, NDArray[Any]] = {} if detector is None else detector.memory
        self.highest = -np.inf

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the detector's score. If it is the highest so far, or NaN, store it."""
        score = 0.0 if self._detector is None else self._detector.score(deltas, stage)
        if not score <= self.highest:
            self.highest = score
        return score

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Pass an accepted sample to the detector, if there is one."""
        if self._detector is not None:
            self._detector.learn(deltas, stage)

    def take_highest(self) -> float:
        """Return the highest score since the last call, or minus infinity if nothing was scored."""
        highest, self.highest = self.highest, -np.inf
        return highest


def replay(
    trace: Columns,
    detector: Detector | None,
    params: PreprocessParams | None = None,
    *,
    protect: frozenset[Stage] = ALL_STAGES,
    patience: int = 0,
    plans: Sequence[Trajectory] = (),
    strikes: Sequence[PlanStrike] = (),
) -> Iterator[_Judgement]:
    """Judge every message of a trace in the order of arrival, and yield each judgement.

    Nothing is recomputed after an alarm: the messages are always those of the recorded flight.

    Args:
        detector: New detector; None computes only the deltas.
        patience: Maximum number of consecutive alarms for one kind of message. The message that
            raises one more is accepted. With 0, every message becomes the reference, so that scores
            do not depend on the threshold.
        plans: Published plans. The active plan is judged when it is new, when a waypoint begins,
            and when a fault strikes it. Its score counts towards the tick's.
        strikes: Changes that a fault made to plans after their publication.

    Raises:
        ModelError: A column is missing.
    """
    messages = _Messages(trace)
    flown = _FlownPlans(trace, plans, strikes)
    probe = _Probe(detector)
    gate = Gate(probe, protect, params)
    in_a_row = {True: 0, False: 0}
    for row, stamp_s in enumerate(messages.stamps_s.tolist()):
        for is_report, message in ((True, messages.report(row)), (False, messages.command(row))):
            if isinstance(message, CollisionReport):
                alarm = gate.judge_report(message)
            elif message is not None:
                if (ahead := flown.ahead(row, stamp_s)) is not None:
                    gate.judge_ahead(*ahead)
                alarm = gate.judge_tick(messages.waypoint(row), 0, message)
            else:
                continue
            judged = _Judgement(
                stamp_s=stamp_s,
                report=message if isinstance(message, CollisionReport) else None,
                new_waypoint=Stage.PLANNING in gate.fresh,
                deltas=gate.deltas,
                score=probe.take_highest(),
                alarm=alarm,
            )
            in_a_row[is_report] = in_a_row[is_report] + 1 if alarm is not None else 0
            if in_a_row[is_report] > patience:
                in_a_row[is_report] = 0
                (gate.accept_report if is_report else gate.accept_tick)()
            yield judged


class _FlownPlans:
    """The active plan in each row of a trace."""

    def __init__(
        self, trace: Columns, plans: Sequence[Trajectory], strikes: Sequence[PlanStrike]
    ) -> None:
        self._plans = {plan.stamp_s: plan for plan in plans}
        self._strikes = sorted(strikes, key=lambda strike: strike.stamp_s)
        self._judged: tuple[Trajectory | None, int] = (None, -1)
        if not plans:
            return
        if not {"trajectory_stamp_s", "waypoint_index"} <= set(trace):
            raise ModelError("the trace needs the columns trajectory_stamp_s and waypoint_index")
        self._stamps_s = _reals(trace["trajectory_stamp_s"])
        self._waypoints = _reals(trace["waypoint_index"])

    def ahead(self, row: int, stamp_s: float) -> tuple[Trajectory, int] | None:
        """Return the active plan and its current waypoint's index, or None if no judgement is due.

        A judgement is due if the plan or the waypoint has changed since the last call.
        """
        if not self._plans:
            return None
        while self._strikes and self._strikes[0].stamp_s <= stamp_s + 1e-9:
            self._strike(self._strikes.pop(0), float(self._stamps_s[row]))
        plan = self._plans.get(float(self._stamps_s[row]))
        if plan is None:
            return None
        waypoint = int(self._waypoints[row])
        before, self._judged = self._judged, (plan, waypoint)
        return None if plan is before[0] and waypoint == before[1] else (plan, waypoint)

    def _strike(self, strike: PlanStrike, plan_stamp_s: float) -> None:
        """Apply a strike to the active plan, unless the published value already includes it."""
        plan, state = self._plans.get(plan_stamp_s), BY_NAME[strike.state]
        if plan is None or strike.waypoint >= len(plan.waypoints):
            return
        if state.read(plan, strike.waypoint) == strike.before:
            struck = state.write(plan, strike.waypoint, strike.after)
            assert isinstance(struck, Trajectory)
            self._plans[plan_stamp_s] = struck


class _Messages:
    """Reconstructs the messages of a trace from its rows."""

    def __init__(self, trace: Columns) -> None:
        names = ["stamp_s", *_REPORT, *_WAYPOINT, *_COMMAND]
        missing = [name for name in names if name not in trace]
        if missing:
            raise ModelError(f"the trace has no column {missing[0]!r}")
        self.stamps_s = _reals(trace["stamp_s"])
        self._reports, self._waypoints, self._commands = (
            np.column_stack([_reals(trace[name]) for name in group])
            for group in (_REPORT, _WAYPOINT, _COMMAND)
        )
        self._has_waypoint = _present(trace["waypoint_x"])
        self._has_command = _present(trace["command_yaw"])
        self._new_report = _present(trace["future_collision_seq"])
        self._new_report &= _changes(self._reports, trace, ("report_stamp_s",))
        self._new_waypoint = self._has_waypoint & (
            _changes(self._waypoints, trace, ("waypoint_index", "trajectory_stamp_s"))
            | ~np.concatenate([[False], self._has_waypoint[:-1]])
        )
        self._trajectory: Trajectory | None = None
        collision = trace.get("collision")  # without it, a finite time means a collision
        self._collisions = np.isfinite(self._reports[:, 0]) if collision is None else collision

    def report(self, row: int) -> CollisionReport | None:
        """Return the collision report that took effect in this tick, or None if none did."""
        if not self._new_report[row]:
            return None
        time_s, seq = self._reports[row].tolist()
        return CollisionReport(
            stamp_s=self.stamps_s[row],
            collision=bool(self._collisions[row]),
            time_to_collision_s=time_s,
            future_collision_seq=int(seq),
        )

    def waypoint(self, row: int) -> Trajectory | None:
        """Return a trajectory that has only the current waypoint, or None if there is none.

        It is the same object until the waypoint changes.
        """
        if self._new_waypoint[row]:
            self._trajectory = Trajectory(
                stamp_s=self.stamps_s[row],
                waypoints=self._waypoints[row : row + 1],
                durations_s=np.ones(1),
                trajectory_seq=0,
                future_collision_seq=0,
            )
        return self._trajectory if self._has_waypoint[row] else None

    def command(self, row: int) -> Command | None:
        """Return the command of this tick, or None before the first command."""
        if not self._has_command[row]:
            return None
        return Command(
            stamp_s=self.stamps_s[row],
            velocity_enu_mps=self._commands[row, 0:3],
            yaw_rad=float(self._commands[row, 3]),
        )


def _reals(column: NDArray[Any]) -> FloatArray:
    return np.ma.filled(column.astype(np.float64), np.nan)


def _present(column: NDArray[Any]) -> NDArray[np.bool_]:
    """Return, for each row, True if it has a value.

    A row without a value is masked or, in an array without a mask, NaN.
    """
    if isinstance(column, np.ma.MaskedArray):
        return ~np.ma.getmaskarray(column)
    return ~np.isnan(_reals(column))


def _changes(values: FloatArray, trace: Columns, markers: tuple[str, ...]) -> NDArray[np.bool_]:
    """Return, for each row, True if its values or its markers differ from the previous row's."""
    marked = [_reals(trace[name]) for name in markers if name in trace]
    patterns = np.column_stack([values, *marked]).view(np.int64)  # NaN equals itself
    changed = np.ones(len(patterns), np.bool_)
    changed[1:] = (patterns[1:] != patterns[:-1]).any(axis=1)
    return changed


def columns_of(table: Any) -> dict[str, NDArray[Any]]:
    """Return the columns of an Arrow table, except text, as masked arrays keyed by name.

    Masked arrays distinguish NaN from null.
    """
    columns: dict[str, NDArray[Any]] = {}
    for name in table.column_names:
        column = table[name].combine_chunks()
        if str(column.type) == "string":
            continue
        fill = False if str(column.type) == "bool" else 0
        values = column.fill_null(fill).to_numpy(zero_copy_only=False)
        columns[name] = np.ma.array(values, mask=column.is_null().to_numpy(zero_copy_only=False))
    return columns


SCHEMA = "2"
_CODED = (*NAMES, *(state.name for state in EXTENDED))
_FLAGS = ("reports", "plan_steps", "new_waypoint")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSamples:
    """Samples of one error-free flight: reports and ticks in order, then the steps of its plans."""

    world: str
    seed: int
    stamps_s: FloatArray  # (n,)
    reports: NDArray[np.bool_]  # (n,) True for a collision report
    plan_steps: NDArray[np.bool_]  # (n,) True for a step of a plan; otherwise a control tick
    new_waypoint: NDArray[np.bool_]  # (n,) True for a control tick with new planning states
    deltas: Codes  # (n, COUNT)
    extended: Codes  # (n, 3) changes of extended states; a plan's are in the row of its first step

    @classmethod
    def of_ticks(
        cls, ticks: Iterable[tuple[float, Trajectory | None, Command]], world: str, seed: int
    ) -> FlightSamples:
        """Extract the samples of a flight from its control ticks.

        Each tick consists of its stamp, waypoint and command. The waypoint is a trajectory with one
        row, and is the same object until it changes.
        """
        gate, rows = Gate(_Probe(None)), []
        for stamp_s, trajectory, command in ticks:
            gate.judge_tick(trajectory, 0, command)
            rows.append((stamp_s, Stage.PLANNING in gate.fresh, gate.deltas))
        none = np.zeros(len(rows), np.bool_)
        return cls(
            world=world,
            seed=seed,
            stamps_s=np.array([stamp_s for stamp_s, _, _ in rows]),
            reports=none,
            plan_steps=none,
            new_waypoint=np.array([new for _, new, _ in rows], np.bool_),
            deltas=np.array([deltas for _, _, deltas in rows], np.int16).reshape(-1, COUNT),
            extended=np.zeros((len(rows), len(EXTENDED)), np.int16),
        )

    @classmethod
    def of_trace(
        cls,
        trace: Columns,
        world: str,
        seed: int,
        params: PreprocessParams | None = None,
        plans: Sequence[Trajectory] = (),
    ) -> FlightSamples:
        """Extract the samples of a flight from its trace and its plans.

        Args:
            plans: All published plans. The trace contains only the flown waypoints.
        """
        params = params or PreprocessParams()
        judged = list(replay(trace, None, params))
        reports = [judgement.report for judgement in judged if judgement.report is not None]
        of_reports, unchanged = iter(_extended_changes(reports)), np.zeros(len(EXTENDED), np.int16)
        rows: list[tuple[float, bool, bool, bool, Codes, Codes]] = []
        for j in judged:
            changes = unchanged if j.report is None else next(of_reports)
            rows.append((j.stamp_s, bool(j.report), False, j.new_waypoint, j.deltas, changes))
        for plan, changes in zip(plans, _extended_changes(plans), strict=True):
            for deltas in _plan_steps(plan, params):
                rows.append((plan.stamp_s, False, True, False, deltas, changes))
                changes = unchanged  # those of a plan are in its first row
        columns: Any = list(zip(*rows, strict=True)) or [()] * 6
        stamps_s, is_report, is_step, new_waypoint, coded, extended = columns
        return cls(
            world=world,
            seed=seed,
            stamps_s=np.array(stamps_s, np.float64),
            reports=np.array(is_report, np.bool_),
            plan_steps=np.array(is_step, np.bool_),
            new_waypoint=np.array(new_waypoint, np.bool_),
            deltas=np.array(coded, np.int16).reshape(-1, COUNT),
            extended=np.array(extended, np.int16).reshape(-1, len(EXTENDED)),
        )

    def of_stage(self, stage: Stage) -> Codes:
        """Return the deltas (m, COUNT) of the samples that have new states of a stage."""
        if stage is Stage.PERCEPTION:
            return self.deltas[self.reports]
        if stage is Stage.PLANNING:
            return self.deltas[self.new_waypoint | self.plan_steps]
        return self.deltas[~(self.reports | self.plan_steps)]

    def scores(self, detector: Detector) -> FloatArray:
        """Return the score of every sample, (n,): the highest score among the sample's stages."""
        scores = np.zeros(len(self.deltas))
        flags = (self.reports, self.plan_steps, self.new_waypoint)
        rows = zip(self.deltas, *(flag.tolist() for flag in flags), strict=True)
        for row, (deltas, report, step, new) in enumerate(rows):
            if report:
                scores[row] = detector.score(deltas, Stage.PERCEPTION)
                continue
            if not (step and detector.per_stage):
                scores[row] = detector.score(deltas, Stage.CONTROL)
            if (new or step) and detector.per_stage:
                scores[row] = max(scores[row], detector.score(deltas, Stage.PLANNING))
        return scores


def _plan_steps(plan: Trajectory, params: PreprocessParams) -> Codes:
    """Return the deltas (n - 1, COUNT) of a plan's steps, computed as in the gate."""
    rows = len(plan.waypoints)
    steps, changes = np.empty(rows, np.int64), np.empty((rows, COUNT), np.int16)
    count = preprocess.plan_deltas(plan.waypoints, 0, params.working_array(), steps, changes)
    deltas = np.zeros((max(0, rows - 1), COUNT), np.int16)
    deltas[steps[:count]] = changes[:count]
    return deltas


def _extended_changes(messages: Sequence[CollisionReport | Trajectory]) -> Codes:
    """Return the changes (n, 3) of the extended states from message to message.

    The messages must be of one kind. The states of the first are compared with 0.
    """
    changes = np.zeros((len(messages), len(EXTENDED)), np.int16)
    before = [0] * len(EXTENDED)
    for row, message in enumerate(messages):
        for place, code in preprocess.extended_codes(message):
            change = code - before[place]
            changes[row, place] = min(max(change, -preprocess.LIMIT), preprocess.LIMIT)
            before[place] = code
    return changes


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset:
    """The samples of several flights, each with a different combination of world and seed."""

    flights: tuple[FlightSamples, ...]
    preprocess: PreprocessParams
    stack: StackMark  # stack of all flights

    def __post_init__(self) -> None:
        keys = [(flight.world, flight.seed) for flight in self.flights]
        if len(set(keys)) != len(keys):
            raise ModelError("a data set must contain each flight (world and seed) only once")

    def __len__(self) -> int:
        return len(self.flights)

    def save(self, path: Path) -> None:
        """Write the data set as Parquet, atomically. Equal data sets give equal bytes."""
        import pyarrow as pa

        schema = pa.schema(
            [("world", pa.string()), ("seed", pa.int64()), ("stamp_s", pa.float64())]
            + [(flag, pa.bool_()) for flag in _FLAGS]
            + [(name, pa.int16()) for name in _CODED]
        )
        tables = [schema.empty_table()]
        for flight in self.flights:
            named = [[value] * len(flight.stamps_s) for value in (flight.world, flight.seed)]
            flags = [getattr(flight, flag) for flag in _FLAGS]
            codes = np.column_stack([flight.deltas, flight.extended]).T
            tables.append(pa.table([*named, flight.stamps_s, *flags, *codes], schema=schema))
        stack = {"mavfi_stack": self.stack.name, "mavfi_stack_digest": self.stack.digest}
        metadata = {**_signature(self.preprocess), **stack}
        write_parquet(path, pa.concat_tables(tables).replace_schema_metadata(metadata))

    @classmethod
    def load(cls, path: Path, preprocess: PreprocessParams | None = None) -> Dataset:
        """Read a data set from a file that `save` has written.

        Args:
            preprocess: Parameters that the data set must have been made with.

        Raises:
            RecordError: The file is unreadable.
            ModelError: The file is not a data set, or was made with another schema, state table or
                preprocessing.
        """
        params = preprocess or PreprocessParams()
        table = read_parquet(path, "data set")
        pairs = (table.schema.metadata or {}).items()
        metadata = {
            key.decode(errors="replace"): text.decode(errors="replace") for key, text in pairs
        }
        if "mavfi_samples" not in metadata:
            raise ModelError("not a mavfi data set", path=path)
        if metadata | _signature(params) != metadata or "mavfi_stack" not in metadata:
            raise ModelError(
                "was made with another schema, state table or preprocessing; create it again",
                path=path,
            )
        stack = StackMark(name=metadata["mavfi_stack"], digest=metadata["mavfi_stack_digest"])
        return cls(flights=tuple(_flights(table)), preprocess=params, stack=stack)


def _signature(params: PreprocessParams) -> dict[str, str]:
    return {
        "mavfi_samples": SCHEMA,
        "mavfi_states": preprocess.STATES_DIGEST,
        "mavfi_preprocess": params.digest(),
    }


def _flights(table: Any) -> Iterator[FlightSamples]:
    columns = {name: table[name].to_numpy() for name in table.column_names}
    worlds, seeds = columns["world"], columns["seed"]
    rows = len(worlds)
    if not rows:
        return
    changed = (worlds[1:] != worlds[:-1]) | (seeds[1:] != seeds[:-1])
    edges = [0, *(np.flatnonzero(changed) + 1).tolist(), rows]
    coded = np.column_stack([columns[name] for name in _CODED]).astype(np.int16)
    for start, end in itertools.pairwise(edges):
        yield FlightSamples(
            world=str(worlds[start]),
            seed=int(seeds[start]),
            stamps_s=columns["stamp_s"][start:end],
            **{flag: columns[flag][start:end].astype(np.bool_) for flag in _FLAGS},
            deltas=coded[start:end, :COUNT],
            extended=coded[start:end, COUNT:],
        )
