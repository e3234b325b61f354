"""Recorded flights: their traces replayed through the gate, and data sets of their samples.

A replay gives the scores of a detector, and the samples of error-free flights to fit models to. One
row of a data set is one judged message: a collision report, a control tick, or one step of a
published plan from waypoint to waypoint. Its deltas are the detector's input.

A trace maps column names to arrays with one row per control tick. It has `stamp_s` and every
monitored state by its name (NaN or masked before the first message with the state). Optional
columns `report_stamp_s`, `waypoint_index` and `trajectory_stamp_s` identify a new message with
unchanged values. Without them a message counts as new if one of its values changes.

A trace holds the present waypoint only, but the gate also judges the active plan. The replay does
this, too, if it gets the published plans and the changes that a fault made to the active one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
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
    """A value that a fault changed in the active plan."""

    stamp_s: float
    state: str
    waypoint: int
    before: float | int | bool
    after: float | int | bool


@dataclass(frozen=True, slots=True, kw_only=True)
class _Judgement:
    stamp_s: float
    report: bool  # True for a collision report, False for a control tick
    new_waypoint: bool
    deltas: Codes  # (COUNT,)
    score: float  # highest score of the stages and of the plan's steps ahead
    alarm: Alarm | None


class _Probe:
    """Wraps a detector, or none, and keeps the highest score since the last `look`."""

    def __init__(self, detector: Detector | None) -> None:
        self._detector = detector
        self.name = "none" if detector is None else detector.name
        self.per_stage = detector is not None and detector.per_stage
        self.threshold = np.inf if detector is None else detector.threshold
        self.memory: Mapping[str, NDArray[Any]] = {} if detector is None else detector.memory
        self.highest = -np.inf

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the detector's score, or 0 without one. Keep it if it is the highest or NaN."""
        score = 0.0 if self._detector is None else self._detector.score(deltas, stage)
        if not score <= self.highest:
            self.highest = score
        return score

    def learn(self, deltas: Codes, stage: Stage) -> None:
        if self._detector is not None:
            self._detector.learn(deltas, stage)

    def look(self) -> float:
        """Return the highest score since the last look; minus infinity if there was none."""
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
    """Judge every message of a trace in the order of arrival.

    Nothing is recomputed; the messages are those of the flight.

    Args:
        detector: New detector; None computes the deltas only.
        patience: Maximum number of consecutive alarms for one kind of message. The next message is
            accepted. With 0 every message becomes the reference, so that scores do not depend on
            the threshold.
        plans: Published plans. The active plan is judged when it is new, when a waypoint begins,
            and when a fault strikes it. The score is part of the tick's.
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
                report=is_report,
                new_waypoint=Stage.PLANNING in gate.fresh,
                deltas=gate.deltas,
                score=probe.look(),
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
        self._looked: tuple[Trajectory | None, int] = (None, -1)
        if not plans:
            return
        if not {"trajectory_stamp_s", "waypoint_index"} <= set(trace):
            raise ModelError("the trace does not say which plan is flown")
        self._stamps_s = _reals(trace["trajectory_stamp_s"])
        self._waypoints = _reals(trace["waypoint_index"])

    def ahead(self, row: int, stamp_s: float) -> tuple[Trajectory, int] | None:
        """Return the plan to judge and its present waypoint; None if the gate does not judge."""
        if not self._plans:
            return None
        while self._strikes and self._strikes[0].stamp_s <= stamp_s + 1e-9:
            self._strike(self._strikes.pop(0), float(self._stamps_s[row]))
        plan = self._plans.get(float(self._stamps_s[row]))
        if plan is None:
            return None
        waypoint = int(self._waypoints[row])
        seen, self._looked = self._looked, (plan, waypoint)
        return None if plan is seen[0] and waypoint == seen[1] else (plan, waypoint)

    def _strike(self, strike: PlanStrike, plan_stamp_s: float) -> None:
        """Apply a strike to the active plan, unless the value was published so."""
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
        """Return the report that took effect in this tick, or None."""
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
        """Return a trajectory of the present waypoint only, the same object until it changes."""
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
        if not self._has_command[row]:
            return None
        return Command(
            stamp_s=self.stamps_s[row],
            velocity_enu_mps=self._commands[row, 0:3],
            yaw_rad=float(self._commands[row, 3]),
        )


def _reals(column: NDArray[Any]) -> FloatArray:
    filled: FloatArray = np.ma.filled(column.astype(np.float64), np.nan)
    return filled


def _present(column: NDArray[Any]) -> NDArray[np.bool_]:
    """Return True for rows with a value: not masked, and not NaN in a plain array."""
    if isinstance(column, np.ma.MaskedArray):
        return ~np.ma.getmaskarray(column)
    return ~np.isnan(_reals(column))


def _changes(values: FloatArray, trace: Columns, markers: tuple[str, ...]) -> NDArray[np.bool_]:
    """Return True for rows (n,) whose values or marker columns differ from the last row."""
    marked = [_reals(trace[name]) for name in markers if name in trace]
    patterns = np.column_stack([values, *marked]).view(np.int64)  # NaN equals itself
    changed = np.ones(len(patterns), np.bool_)
    changed[1:] = (patterns[1:] != patterns[:-1]).any(axis=1)
    return changed


def columns_of(table: Any) -> dict[str, NDArray[Any]]:
    """Return the columns of an Arrow table as masked arrays, which tell NaN from null."""
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
    """Samples of one error-free flight, oldest first."""

    world: str
    seed: int
    stamps_s: FloatArray  # (n,)
    reports: NDArray[np.bool_]  # (n,) True for a collision report
    plan_steps: NDArray[np.bool_]  # (n,) True for a step of a plan; otherwise a control tick
    new_waypoint: NDArray[np.bool_]  # (n,) True for a control tick with new planning states
    deltas: Codes  # (n, COUNT)
    extended: Codes  # (n, 3) extended states; those of a plan are in the row of its first step

    @classmethod
    def of_trace(
        cls,
        trace: Columns,
        world: str,
        seed: int,
        params: PreprocessParams | None = None,
        plans: Sequence[Trajectory] = (),
    ) -> FlightSamples:
        """Extract the samples of a flight.

        Args:
            plans: All published plans. The trace holds the flown waypoints only.
        """
        params = params or PreprocessParams()
        judged = list(replay(trace, None, params))
        steps = [step for plan in plans for step in _plan_steps(plan, params)]
        stamps = [plan.stamp_s for plan in plans for _ in range(len(plan.waypoints) - 1)]
        extended = np.zeros((len(judged) + len(steps), len(EXTENDED)), np.int16)
        messages = _Messages(trace)
        reports = [messages.report(row) for row in range(len(messages.stamps_s))]
        extended[np.flatnonzero([each.report for each in judged])] = _extended_changes(
            [report for report in reports if report is not None]
        )
        firsts = np.cumsum([len(judged), *(len(plan.waypoints) - 1 for plan in plans)])[:-1]
        for first, plan, row in zip(firsts.tolist(), plans, _extended_changes(plans), strict=True):
            if len(plan.waypoints) > 1:
                extended[first] = row
        no_steps, no_messages = [False] * len(steps), [False] * len(judged)
        return cls(
            world=world,
            seed=seed,
            stamps_s=np.array([each.stamp_s for each in judged] + stamps, np.float64),
            reports=np.array([each.report for each in judged] + no_steps, np.bool_),
            plan_steps=np.array(no_messages + [True] * len(steps), np.bool_),
            new_waypoint=np.array([each.new_waypoint for each in judged] + no_steps, np.bool_),
            deltas=np.array([each.deltas for each in judged] + steps, np.int16).reshape(-1, COUNT),
            extended=extended,
        )

    def of_stage(self, stage: Stage) -> Codes:
        """Return the deltas (m, COUNT) of the samples with new states of a stage."""
        if stage is Stage.PERCEPTION:
            return self.deltas[self.reports]
        if stage is Stage.PLANNING:
            return self.deltas[self.new_waypoint | self.plan_steps]
        return self.deltas[~(self.reports | self.plan_steps)]

    def scores(self, detector: Detector) -> FloatArray:
        """Return the score of every judged message (n,): the highest score of its stages."""
        found = np.zeros(len(self.deltas))
        flags = (self.reports, self.plan_steps, self.new_waypoint)
        rows = zip(self.deltas, *(flag.tolist() for flag in flags), strict=True)
        for row, (deltas, report, step, new) in enumerate(rows):
            if report:
                found[row] = detector.score(deltas, Stage.PERCEPTION)
                continue
            if not (step and detector.per_stage):
                found[row] = detector.score(deltas, Stage.CONTROL)
            if (new or step) and detector.per_stage:
                found[row] = max(found[row], detector.score(deltas, Stage.PLANNING))
        return found


def _plan_steps(plan: Trajectory, params: PreprocessParams) -> Codes:
    """Return the deltas (n - 1, COUNT) of a plan's steps, computed as in the gate."""
    rows = len(plan.waypoints)
    steps, changes = np.empty(rows, np.int64), np.empty((rows, COUNT), np.int16)
    count = preprocess.plan_deltas(plan.waypoints, 0, params.working_array(), steps, changes)
    found = np.zeros((max(0, rows - 1), COUNT), np.int16)
    found[steps[:count]] = changes[:count]
    return found


def _extended_changes(messages: Sequence[CollisionReport | Trajectory]) -> Codes:
    """Return the changes (n, 3) of the extended states between messages of one kind."""
    found = np.zeros((len(messages), len(EXTENDED)), np.int16)
    before = [0] * len(EXTENDED)
    for row, message in enumerate(messages):
        for place, code in preprocess.extended_codes(message):
            found[row, place] = min(max(code - before[place], -preprocess.LIMIT), preprocess.LIMIT)
            before[place] = code
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset:
    """Flights with distinct combinations of world and seed."""

    flights: tuple[FlightSamples, ...]
    preprocess: PreprocessParams
    stack: StackMark  # stack of all flights

    def __post_init__(self) -> None:
        keys = [(flight.world, flight.seed) for flight in self.flights]
        if len(set(keys)) != len(keys):
            raise ModelError("a data set holds each flight (world and seed) once only")

    def __len__(self) -> int:
        return len(self.flights)

    def save(self, path: Path) -> None:
        """Write the data set as Parquet, atomically. Equal data sets give equal bytes."""
        import pyarrow as pa

        flights = self.flights
        lengths = [len(flight.stamps_s) for flight in flights]
        worlds = np.repeat([f.world for f in flights], lengths).tolist()
        columns: dict[str, pa.Array] = {
            "world": pa.array(worlds, pa.string()),
            "seed": pa.array(np.repeat([f.seed for f in flights], lengths), pa.int64()),
            "stamp_s": pa.array(np.concatenate([[], *(f.stamps_s for f in flights)]), pa.float64()),
        }
        for flag in _FLAGS:
            flags = np.concatenate([np.zeros(0, np.bool_), *(getattr(f, flag) for f in flights)])
            columns[flag] = pa.array(flags, pa.bool_())
        codes = [np.column_stack([f.deltas, f.extended]) for f in flights]
        coded = np.concatenate([np.zeros((0, len(_CODED)), np.int16), *codes])
        for place, name in enumerate(_CODED):
            columns[name] = pa.array(coded[:, place], pa.int16())
        stack = {"mavfi_stack": self.stack.name, "mavfi_stack_digest": self.stack.digest}
        metadata = {**_signature(self.preprocess), **stack}
        write_parquet(path, pa.table(columns).replace_schema_metadata(metadata))

    @classmethod
    def load(cls, path: Path, preprocess: PreprocessParams | None = None) -> Dataset:
        """Read a data set.

        Args:
            preprocess: Parameters that the data set must have been made with.

        Raises:
            RecordError: The file is unreadable.
            ModelError: It is not a data set, or was made with another state table or other
                preprocessing.
        """
        params = preprocess or PreprocessParams()
        table = read_parquet(path, "data set")
        pairs = (table.schema.metadata or {}).items()
        metadata = {
            key.decode(errors="replace"): text.decode(errors="replace") for key, text in pairs
        }
        if "mavfi_samples" not in metadata:
            raise ModelError("is not a data set of mavfi", path=path)
        if metadata | _signature(params) != metadata or "mavfi_stack" not in metadata:
            raise ModelError(
                "made for another version, table of states or preprocessing; fly it anew", path=path
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
