"""The gate, which checks every message before it takes effect and may raise an alarm.

A message that raises an alarm does not become the reference, and the detector does not learn from
it.
The caller withholds the message and recomputes the stage. If recomputation confirms the message,
the caller accepts it with `accept_report`, `accept_plan` or `accept_tick`, and the message becomes
the reference.

The alarm of a per-stage detector (`Detector.per_stage`) names the stage with anomalous states. A
detector over all stages scores one vector when a report arrives, and one at each tick. The latter
includes a report received since the last tick. The alarm always names control (paper, section V-D).
The gate also checks the steps of a plan. An alarm about a step names the waypoint to drop.

An extended watch checks the extended states of reports and plans one by one before the detector
scores the message. Whatever the detector, its alarm names the stage of the message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.types import CollisionReport, Command, FloatArray, Message, Stage, Trajectory
from mavfi_cli.detect import preprocess
from mavfi_cli.detect.base import OF_CONTROL, OF_PLANNING, PASSED, Detector, FittedDetector
from mavfi_cli.detect.baselines import MARGIN
from mavfi_cli.detect.preprocess import COUNT, EXTENDED, NAMES, SPANS, Codes, PreprocessParams

_NO_WAYPOINTS = np.zeros((0, 10))
_TICK, _TICK_AND_WAYPOINT = (Stage.CONTROL,), (Stage.PLANNING, Stage.CONTROL)
ALL_STAGES = frozenset(Stage)
# Arguments of `preprocess.take_tick` before the working array.
_Tick = tuple[FloatArray, int, FloatArray, float, bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """An alarm about an anomalous message, raised by the detector or by the extended watch."""

    stage: Stage  # stage to recompute
    detector: str
    score: float
    threshold: float
    states: tuple[str, ...]  # anomalous states, worst first
    waypoint: int | None = None  # waypoint to drop, for the alarm of a plan
    mended: Trajectory | None = None  # active plan, reset to the accepted extended states


class _ExtendedWatch:
    """Judges each extended state by its range of changes in error-free flights.

    The change since the last accepted message must lie between the smallest and the largest change
    in the training flights. At the start, the counters are 0 and no collision is predicted, so even
    the first message is judged. A planner that owns its counter also counts plans that never took
    effect. So after n messages that were not accepted, the sum of n + 1 changes is allowed.

    Attributes:
        memory: Array (3, 3), int16, with one column per state. Its rows are the last accepted
            codes, the smallest changes and the largest changes. A modification takes effect at
            once.
    """

    def __init__(self, ranges: preprocess.Ranges) -> None:
        rows = zip(*(ranges[state.name] for state in EXTENDED), strict=True)
        self.memory: Codes = np.array([[0] * len(EXTENDED), *rows], np.int16)
        self._lost = {CollisionReport: 0, Trajectory: 0}  # messages since the last accepted one
        self._accepted: dict[float, Trajectory] = {}  # plans by their stamps

    def judge(self, message: CollisionReport | Trajectory) -> Alarm | None:
        """Judge a message on arrival, and return an alarm, or None if the message passes.

        The caller must then call `accept` or `lose`.
        """
        return self._judge(message, self.memory[0].tolist(), self._lost[type(message)] + 1)

    def accept(self, message: CollisionReport | Trajectory) -> None:
        """Accept a message, which takes effect and becomes the reference."""
        for place, code in preprocess.extended_codes(message):
            self.memory[0, place] = code
        self._lost[type(message)] = 0
        if isinstance(message, Trajectory):
            self._accepted[message.stamp_s] = message

    def lose(self, kind: type[CollisionReport | Trajectory]) -> None:
        """Record that a message of that kind did not take effect."""
        self._lost[kind] += 1

    def judge_flown(self, plan: Trajectory) -> Alarm | None:
        """Judge the active plan again, because its states may have changed since it was accepted.

        Return an alarm with the plan reset to the accepted states, or None if the plan passes.
        """
        accepted = self._accepted.get(plan.stamp_s)
        if accepted is None:
            return None
        alarm = self._judge(plan, dict(preprocess.extended_codes(accepted)), 1)
        if alarm is None:
            return None
        mended: Message = plan
        for state in EXTENDED:
            if isinstance(accepted, state.message):
                mended = state.write(mended, 0, state.read(accepted, 0))
        assert isinstance(mended, Trajectory)
        return replace(alarm, mended=mended)

    def _judge(
        self,
        message: CollisionReport | Trajectory,
        references: Mapping[int, int] | Sequence[int],
        steps: int,
    ) -> Alarm | None:
        anomalies: list[tuple[int, int]] = []
        for place, code in preprocess.extended_codes(message):
            delta = min(max(code - references[place], -preprocess.LIMIT), preprocess.LIMIT)
            lowest, highest = self.memory[1:, place].tolist()
            distance = max(steps * lowest - delta, delta - steps * highest)
            if distance > 0:
                anomalies.append((-distance, place))
        if not anomalies:
            return None
        anomalies.sort()
        return Alarm(
            stage=EXTENDED[anomalies[0][1]].stage,
            detector="extended watch",
            score=float(-anomalies[0][0]),
            threshold=MARGIN,
            states=tuple(EXTENDED[place].name for _, place in anomalies),
        )


class Gate:
    """The gate of one mission, which checks every message before it takes effect.

    The methods that judge a message return an alarm, or None if the message passes.

    Args:
        detector: New detector for this mission only, because it learns.
        protect: Stages to watch. The deltas of the other stages stay 0.
        params: Preprocessing parameters; must be those of the detector's model.
        extended: Ranges of the extended states to watch; None watches none of them.

    Attributes:
        fresh: Stages with a new sample in the last judged message.
    """

    def __init__(
        self,
        detector: Detector,
        protect: frozenset[Stage] = ALL_STAGES,
        params: PreprocessParams | None = None,
        extended: preprocess.Ranges | None = None,
    ) -> None:
        self.detector = detector
        self._watch = None if extended is None else _ExtendedWatch(extended)
        self._report: CollisionReport | None = None  # last judged report
        self.protect = protect
        self.fresh: tuple[Stage, ...] = ()
        self._per_stage = detector.per_stage
        self._work = (params or PreprocessParams()).working_array()
        self._deltas = self._work[preprocess.DELTA]
        self._trajectory: Trajectory | None = None  # last accepted waypoint
        self._index = -1
        self._judged: tuple[Trajectory | None, int] = (None, -1)
        self._pending = False  # True if a report's deltas wait for the next tick
        self._ignored = [slice(*SPANS[stage]) for stage in Stage if stage not in protect]
        self._steps = np.empty(0, np.int64)  # buffer for the steps of a plan, see `_score_steps`
        self._changes = np.empty((0, COUNT), np.int16)
        self._scores = np.empty(0)
        fitted = detector if isinstance(detector, FittedDetector) else None
        self._flat = None if fitted is None else fitted.flat
        compiled = None if fitted is None or self._ignored else fitted.tick_judge
        self._tick_judge = compiled or self._judge_stages
        self._plan_judge = None if fitted is None else fitted.plan_judge

    @property
    def deltas(self) -> Codes:
        """Copy of the deltas (COUNT,) of the report or control tick that was judged last."""
        deltas: Codes = self._deltas.copy()
        return deltas

    @property
    def memory(self) -> Mapping[str, NDArray[Any]]:
        """All state of the detector and the gate, as writable arrays keyed by name.

        Faults can be injected into these arrays.
        """
        own = {"gate": self._work} | ({} if self._watch is None else {"watch": self._watch.memory})
        return {**own, **self.detector.memory}

    def judge_report(self, report: CollisionReport) -> Alarm | None:
        """Judge a collision report on arrival. Return an alarm, or None if the report passes."""
        preprocess.take_report(report.time_to_collision_s, report.future_collision_seq, self._work)
        self.fresh = (Stage.PERCEPTION,)
        self._pending = False
        if Stage.PERCEPTION not in self.protect:
            self._deltas[:] = 0
            return None
        self._report = report
        alarm = None if self._watch is None else self._watch.judge(report)
        if alarm is None:
            score = self.detector.score(self._deltas, Stage.PERCEPTION)
            if not score <= self.detector.threshold:
                alarm = self._alarm(Stage.PERCEPTION, score, self._deltas)
        if alarm is None:
            self.detector.learn(self._deltas, Stage.PERCEPTION)
            self._pending = not self._per_stage
        else:
            self._refer(Stage.PERCEPTION, preprocess.PREVIOUS)
        return self._settled(report, alarm)

    def judge_plan(self, trajectory: Trajectory) -> Alarm | None:
        """Judge a published plan: its extended states, and all steps from waypoint to waypoint.

        The steps are judged here only if the detector is per-stage. An alarm of a detector over all
        stages would recompute control, but there is no command to recompute yet; see `judge_ahead`.
        """
        if Stage.PLANNING not in self.protect:
            return None
        alarm = None if self._watch is None else self._watch.judge(trajectory)
        if alarm is None and self._per_stage:
            alarm = self._judge_steps(trajectory, 0)
        return self._settled(trajectory, alarm)

    def _settled(self, message: CollisionReport | Trajectory, alarm: Alarm | None) -> Alarm | None:
        """Tell the extended watch whether the message that it judged passed, and return `alarm`."""
        if self._watch is not None:
            self._watch.accept(message) if alarm is None else self._watch.lose(type(message))
        return alarm

    def lose_plan(self) -> None:
        """Record that the planner has failed or that its plan is not used."""
        if self._watch is not None:
            self._watch.lose(Trajectory)

    def judge_ahead(self, trajectory: Trajectory, first: int) -> Alarm | None:
        """Judge the steps of the active plan, starting at waypoint `first`.

        With any detector, call this each time a node that looks ahead receives the plan. The
        collision check would use a corrupted waypoint long before the vehicle reaches it. The call
        does not change the gate, and the detector does not learn.

        Returns:
            An alarm about extended states that differ too much from those of the accepted plan, or
            about the first anomalous step, with the waypoint to drop; None if both pass.
        """
        if Stage.PLANNING not in self.protect:
            return None
        alarm = None if self._watch is None else self._watch.judge_flown(trajectory)
        return alarm or self._judge_steps(trajectory, first)

    def _judge_steps(self, trajectory: Trajectory, first: int) -> Alarm | None:
        rows = len(trajectory.waypoints)
        if rows < 2:
            return None
        scores, threshold = self._score_steps(trajectory, first), self.detector.threshold
        bad = [number for number, score in enumerate(scores) if not score <= threshold]
        if not bad:
            return None
        number, step = bad[0], int(self._steps[bad[0]])
        leaves = len(bad) > 1 and self._steps[bad[1]] == step + 1  # away from the bad waypoint
        only_first = not leaves and step == max(first, 0) and step + 2 < rows
        stage = Stage.PLANNING if self._per_stage else Stage.CONTROL
        deltas, waypoint = self._changes[number], step if only_first else step + 1
        return self._alarm(stage, scores[number], deltas, waypoint)

    def _score_steps(self, trajectory: Trajectory, first: int) -> list[float]:
        """Score those steps of a plan that change a code, starting at waypoint `first`.

        Return their scores. The numbers of these steps and their deltas are written to `_steps` and
        `_changes`.
        """
        waypoints = trajectory.waypoints
        if len(waypoints) > len(self._steps):
            self._steps = np.empty(len(waypoints), np.int64)
            self._changes = np.empty((len(waypoints), COUNT), np.int16)
            self._scores = np.empty(len(waypoints))
        if self._plan_judge is not None:
            count = self._plan_judge(
                self._flat, self._work, waypoints, first, self._steps, self._changes, self._scores
            )
            scores: list[float] = self._scores[:count].tolist()
            return scores
        count = preprocess.plan_deltas(waypoints, first, self._work, self._steps, self._changes)
        stage = Stage.PLANNING if self._per_stage else Stage.CONTROL
        return [self.detector.score(self._changes[number], stage) for number in range(count)]

    def judge_tick(
        self, trajectory: Trajectory | None, index: int, command: Command
    ) -> Alarm | None:
        """Judge the current waypoint and the command, before the command is sent.

        Return an alarm, or None if both pass. A waypoint is a new sample if its trajectory or index
        differs from that of the last accepted one. If its stage raises an alarm, the command
        computed from it is not judged.
        """
        if trajectory is None or (trajectory is self._trajectory and index == self._index):
            waypoints, row = _NO_WAYPOINTS, -1
            self.fresh = _TICK
        else:
            waypoints, row = trajectory.waypoints, index
            self.fresh = _TICK_AND_WAYPOINT
        self._judged = (trajectory, index)
        score, verdict = self._tick_judge(
            self._flat, self._work, waypoints, row,
            command.velocity_enu_mps, command.yaw_rad, self._pending,
        )  # fmt: skip
        self._pending = False
        of_control = self._per_stage and verdict == OF_CONTROL
        if row >= 0 and (verdict == PASSED or of_control):
            self._trajectory, self._index = trajectory, index
        if verdict == PASSED:
            return None
        for stage in _TICK if of_control else self.fresh:
            self._refer(stage, preprocess.PREVIOUS)
        stage = Stage.PLANNING if verdict == OF_PLANNING else Stage.CONTROL
        return self._alarm(stage, score, self._deltas)

    def _judge_stages(
        self, _flat: FloatArray | None, work: Codes, *tick: *_Tick
    ) -> tuple[float, int]:
        """Judge a control tick if the detector has no `tick_judge`, or if a stage is not watched.

        Return the score and the stage of an alarm, or 0 and PASSED without one.
        """
        preprocess.take_tick(*tick, work)
        for span in self._ignored:
            self._deltas[span] = 0
        for stage in self.fresh if self._per_stage else _TICK:
            if self._per_stage and stage not in self.protect:
                continue
            score = self.detector.score(self._deltas, stage)
            if not score <= self.detector.threshold:
                return score, OF_PLANNING if stage is Stage.PLANNING else OF_CONTROL
            self.detector.learn(self._deltas, stage)
        return 0.0, PASSED

    def accept_report(self) -> None:
        """Accept the last judged report despite its alarm, so that it becomes the reference."""
        self._refer(Stage.PERCEPTION, preprocess.CODE)
        if self._watch is not None and self._report is not None:
            self._watch.accept(self._report)

    def accept_plan(self, trajectory: Trajectory) -> None:
        """Accept a published plan despite its alarm."""
        if self._watch is not None:
            self._watch.accept(trajectory)

    def accept_tick(self) -> None:
        """Accept the last judged waypoint and command despite their alarm.

        They become the reference.
        """
        for stage in self.fresh:
            if stage is not Stage.PERCEPTION:
                self._refer(stage, preprocess.CODE)
        if Stage.PLANNING in self.fresh:
            self._trajectory, self._index = self._judged

    def _refer(self, stage: Stage, row: int) -> None:
        """Copy a row of the working array to the references of a stage's states."""
        first, end = SPANS[stage]
        self._work[preprocess.REFERENCE, first:end] = self._work[row, first:end]

    def _alarm(
        self, stage: Stage, score: float, deltas: Codes, waypoint: int | None = None
    ) -> Alarm:
        threshold = self.detector.threshold
        return Alarm(
            stage=stage if self._per_stage else Stage.CONTROL,
            detector=self.detector.name,
            score=float(score),
            threshold=float(threshold),
            states=self._blame(stage, threshold, deltas),
            waypoint=waypoint,
        )

    def _blame(self, stage: Stage, threshold: float, deltas: Codes) -> tuple[str, ...]:
        """Return the names of the states that would raise an alarm on their own, worst first.

        If there is no such state, return the names of all changed states, worst first.
        """
        first, end = SPANS[stage] if self._per_stage else (0, COUNT)
        alone: list[tuple[float, int]] = []
        for place in range(first, end):
            if deltas[place]:
                single = np.zeros_like(deltas)
                single[place] = deltas[place]
                score = self.detector.score(single, stage)
                alone.append((score if score == score else np.inf, place))
        alone.sort(key=lambda entry: (-entry[0], entry[1]))
        above = [place for score, place in alone if score > threshold]
        return tuple(NAMES[place] for place in above or [place for _, place in alone])
