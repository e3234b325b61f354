"""The detector's gate in a mission: decides whether to withhold, recompute or accept a message.

`Protection` judges and counts messages. `Recovery` carries out the response: it recomputes the
stage of a withheld message (paper, section V-E), or holds the vehicle.

    response    report                       plan              active plan          command
    RECOMPUTE   recompute perception         request another   drop the waypoint    recompute it
    HOLD        never                        hold              hold                 hold

PASS and ACCEPT let the message take effect. A vehicle that holds drops the plan, hovers, and
replans from there. docs/explanation/detection.md gives the rules for each alarm and the bounds on
recomputation, with their reasons.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from mavfi_cli.autonomy.pilot import Pilot
from mavfi_cli.autonomy.tracking import without_waypoint
from mavfi_cli.core.compiled import in_cache
from mavfi_cli.core.flight_record import Detection, RecordedAlarm, RecordedRecovery
from mavfi_cli.core.types import CollisionReport, Command, Message, Stage, Trajectory, VehicleState
from mavfi_cli.core.wall import WallClock
from mavfi_cli.detect.gate import Alarm, Gate
from mavfi_cli.detect.preprocess import take_tick
from mavfi_cli.fi.injector import Follower
from mavfi_cli.spec.detector import DetectorConfig

MAX_LISTED_ALARMS = 100
ANNOUNCED_EVERY_S = 1.0  # minimum time between two announced alarms of one stage


class Response(Enum):
    """What the gate does with a message."""

    PASS = "pass"
    RECOMPUTE = "recompute"  # withheld; its stage is recomputed
    HOLD = "hold"  # withheld; the vehicle holds and replans
    ACCEPT = "accept"  # accepted in spite of the alarm, because recomputation confirmed it


@dataclass(slots=True)
class _Outage:
    """Number and total duration of the periods in which no message of a stage was accepted."""

    count: int = 0
    total_s: float = 0.0
    since_s: float | None = None
    in_a_row: int = 0
    alarm: Alarm | None = None  # alarm of the last message, if any


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """The gate's decision about one message, and the alarm that caused it, if any."""

    response: Response
    alarm: Alarm | None = None

    @property
    def withheld(self) -> bool:
        """True if the message does not take effect."""
        return self.response in (Response.RECOMPUTE, Response.HOLD)

    def blames(self, stage: Stage) -> bool:
        """Return True if the alarm names this stage as the one to recompute."""
        return self.alarm is not None and self.alarm.stage is stage


PASSED = Decision(response=Response.PASS)


class NoProtection:
    """The protection of a mission without a detector: it lets every message pass."""

    gate: Gate | None = None

    def report(self, report: CollisionReport, stamp_s: float) -> Decision:
        """Decide whether a collision report that has just arrived takes effect."""
        return PASSED

    def plan(self, plan: Trajectory, stamp_s: float) -> Decision:
        """Decide whether a plan that has just arrived takes effect."""
        return PASSED

    def lose_plan(self) -> None:
        """Handle an answer of the planner that contains no usable plan."""

    def ahead(self, plan: Trajectory, first: int, only: int | None, stamp_s: float) -> Decision:
        """Decide whether the active plan may be used from waypoint `first` to its end.

        Args:
            only: Ignore an alarm at any other waypoint. If None, an alarm at any waypoint counts.
        """
        return PASSED

    def tick(
        self, trajectory: Trajectory | None, index: int, command: Command, stamp_s: float
    ) -> Decision:
        """Decide whether the command of a control tick takes effect.

        It is judged with the current waypoint, which has the given index in the trajectory.
        """
        return PASSED

    def news(self) -> list[str]:
        """Return the lines of text about alarms that are new since the last call."""
        return []

    def summary(self) -> Detection | None:
        """Return the record of checks, alarms and recoveries, or None without a detector."""
        return None


class Protection(NoProtection):
    """The protection of a mission with a detector: a gate that judges and counts messages.

    Args:
        wall: Accumulates the host time of all checks under "gate".
    """

    def __init__(self, config: DetectorConfig, stack: str, wall: WallClock) -> None:
        self._config = config
        self._wall = wall
        detector = config.build(stack)
        stages = frozenset(Stage(name) for name in config.protect)
        self.gate: Gate = Gate(detector, stages, extended=config.extended_ranges(detector))
        self._threshold = detector.threshold
        self._checks = dict.fromkeys(("report", "plan", "ahead", "tick"), 0)
        self._responses = dict.fromkeys((r.value for r in Response if r is not Response.PASS), 0)
        self._outages = {stage: _Outage() for stage in Stage}
        self._alarms: list[RecordedAlarm] = []
        self._news: list[str] = []
        self._announced_s: dict[Stage, float] = {}

    def report(self, report: CollisionReport, stamp_s: float) -> Decision:
        """Decide whether a collision report that has just arrived takes effect."""
        alarm = self._judge("report", self.gate.judge_report, report)
        return self._decide(alarm, "report", Stage.PERCEPTION, stamp_s, self.gate.accept_report)

    def plan(self, plan: Trajectory, stamp_s: float) -> Decision:
        """Decide whether a plan that has just arrived takes effect."""
        alarm = self._judge("plan", self.gate.judge_plan, plan)
        accept = partial(self.gate.accept_plan, plan)
        return self._decide(alarm, "plan", Stage.PLANNING, stamp_s, accept, proven=False)

    def lose_plan(self) -> None:
        """Handle an answer of the planner that contains no usable plan."""
        self.gate.lose_plan()

    def ahead(self, plan: Trajectory, first: int, only: int | None, stamp_s: float) -> Decision:
        """Decide whether the active plan may be used from waypoint `first` to its end.

        Args:
            only: Ignore an alarm at any other waypoint. If None, an alarm at any waypoint counts.
        """
        alarm = self._judge("ahead", self.gate.judge_ahead, plan, first)
        if alarm is None or only not in (None, alarm.waypoint):
            return PASSED
        return self._respond(alarm, "ahead", alarm.stage, stamp_s)

    def tick(
        self, trajectory: Trajectory | None, index: int, command: Command, stamp_s: float
    ) -> Decision:
        """Decide whether the command of a control tick takes effect.

        It is judged with the current waypoint, which has the given index in the trajectory.
        """
        alarm = self._judge("tick", self.gate.judge_tick, trajectory, index, command)
        stage = Stage.CONTROL if alarm is None else alarm.stage
        flown = Stage.PLANNING in self.gate.fresh
        if alarm is None and flown:
            self._outages[Stage.PLANNING].in_a_row = 0
        proven = flown or self.gate.detector.per_stage
        return self._decide(alarm, "tick", stage, stamp_s, self.gate.accept_tick, proven=proven)

    def _judge(self, kind: str, check: Callable[..., Alarm | None], *message: Any) -> Alarm | None:
        self._checks[kind] += 1
        begun_s = perf_counter()
        alarm = check(*message)
        self._wall.add("gate", perf_counter() - begun_s)
        return alarm

    def _decide(
        self,
        alarm: Alarm | None,
        message: str,
        stage: Stage,
        stamp_s: float,
        accept: Callable[[], None],
        *,
        proven: bool = True,
    ) -> Decision:
        """Pass a message without an alarm, or respond to its alarm.

        Args:
            accept: Makes the gate accept the message despite its alarm.
            proven: True if the message contained every state that can raise an alarm in its stage.
                While the vehicle holds, only such a message ends the series of alarms, because
                steps within a plan and the commands of a hover always pass.
        """
        if alarm is not None:
            decision = self._respond(alarm, message, stage, stamp_s)
            if decision.response is Response.ACCEPT:
                accept()
            return decision
        outage = self._outages[stage]
        outage.alarm = None
        if proven or outage.in_a_row < self._config.alarms_max:
            outage.in_a_row = 0
        self._end(outage, stamp_s)
        return PASSED

    def _respond(self, alarm: Alarm, message: str, stage: Stage, stamp_s: float) -> Decision:
        outage = self._outages[stage]
        outage.in_a_row += 1
        is_report, alarms_max = message == "report", self._config.alarms_max
        response = Response.RECOMPUTE
        if outage.in_a_row > alarms_max or (is_report and alarm == outage.alarm):
            response = Response.ACCEPT
        elif outage.in_a_row == alarms_max and not is_report:
            response = Response.HOLD
        outage.alarm = alarm
        self._responses[response.value] += 1
        if outage.since_s is None:
            outage.since_s = stamp_s
            outage.count += 1
        if response is Response.ACCEPT:
            self._end(outage, stamp_s)
        if len(self._alarms) < MAX_LISTED_ALARMS:
            self._alarms.append(
                RecordedAlarm(
                    stamp_s=round(stamp_s, 9),
                    message=message,
                    stage=stage.value,
                    score=alarm.score,
                    states=alarm.states,
                    response=response.value,
                    recomputes=None if alarm.stage is stage else alarm.stage.value,
                )
            )
        self._announce(alarm, stage, response, stamp_s)
        return Decision(response=response, alarm=alarm)

    def _announce(self, alarm: Alarm, stage: Stage, response: Response, stamp_s: float) -> None:
        last_s = self._announced_s.get(stage)
        if (
            response is not Response.HOLD
            and last_s is not None
            and stamp_s - last_s < ANNOUNCED_EVERY_S
        ):
            return
        self._announced_s[stage] = stamp_s
        where = ", ".join(alarm.states[:2]) or "all states together"
        self._news.append(f"{alarm.detector} alarm in {stage.value}: {where}; {response.value}")

    def _end(self, outage: _Outage, stamp_s: float) -> None:
        if outage.since_s is not None:
            outage.total_s += stamp_s - outage.since_s
            outage.since_s = None

    def news(self) -> list[str]:
        """Return the lines of text about alarms that are new since the last call."""
        news, self._news = self._news, []
        return news

    def summary(self) -> Detection:
        """Return the record of checks, alarms and recoveries."""
        return Detection(
            detector=self._config.name,
            protect=self._config.protect,
            threshold=self._threshold,
            checks=self._checks,
            alarm_count=sum(self._responses.values()),
            responses=self._responses,
            alarms=self._alarms,
            recoveries={
                stage.value: RecordedRecovery(count=outage.count, total_s=round(outage.total_s, 9))
                for stage, outage in self._outages.items()
            },
        )

    @staticmethod
    def is_compiled(config: DetectorConfig, stack: str) -> bool:
        """Return True if the code of a detector's gate is compiled.

        If it is not, `warm_up` takes many seconds.
        """
        judge = getattr(config.build(stack), "tick_judge", None)
        return in_cache(judge or take_tick)

    @staticmethod
    def warm_up(config: DetectorConfig, stack: str) -> None:
        """Load and compile all code that a detector's gate needs, before the flight.

        Raises the same errors as `DetectorConfig.build`.
        """
        gate = Gate(config.build(stack))
        report = CollisionReport(
            stamp_s=0.0, collision=False, time_to_collision_s=math.inf, future_collision_seq=0
        )
        plan = Trajectory(
            stamp_s=0.0,
            waypoints=np.zeros((2, 10)),
            durations_s=np.ones(2),
            trajectory_seq=1,
            future_collision_seq=0,
        )
        command = Command(stamp_s=0.0, velocity_enu_mps=np.zeros(3), yaw_rad=0.0)
        for _ in range(2):
            gate.judge_report(report)
            gate.judge_plan(plan)
            gate.judge_ahead(plan, 0)
            gate.judge_tick(plan, 0, command)


class Recovery:
    """Responds to the gate's alarms by acting on perception, the pilot and its active plan.

    Attributes:
        state: Newest vehicle state, from which a holding vehicle replans.
    """

    def __init__(
        self,
        protection: NoProtection,
        pilot: Pilot,
        follower: Follower,
        recompute_perception: Callable[[], None],
    ) -> None:
        self._protection = protection
        self._pilot = pilot
        self._follower = follower
        self._recompute_perception = recompute_perception
        self._judged: tuple[Trajectory | None, int] = (None, -1)
        self.state: VehicleState | None = None

    def recover(self, withheld: Message, decision: Decision) -> None:
        """Start the recovery after the gate has withheld a message.

        A withheld command is recomputed by its sender, not here.
        """
        self._follower.withheld(withheld)
        if isinstance(withheld, Trajectory):
            self._pilot.reject_plan()
        elif isinstance(withheld, CollisionReport):
            if decision.blames(Stage.PERCEPTION):
                self._recompute_perception()
        elif decision.response is Response.RECOMPUTE and decision.blames(Stage.PLANNING):
            self._pilot.want_plan()
        if decision.response is Response.HOLD:
            self._hold()

    def judge_changes(self, stamp_s: float, unharmed: Trajectory) -> None:
        """Judge the active plan if it changed since the last tick, before mission logic uses it.

        A new plan or a new waypoint triggers a check of the whole plan ahead. In between, the gate
        checks only the current waypoint, because 50 checks of the whole plan per second would cost
        an order of magnitude more. So after a strike, only an alarm at that waypoint counts.

        Args:
            unharmed: The plan, already judged by the gate, as it was before this tick's strike.
        """
        active, (judged, judged_at) = self._pilot.active, self._judged
        if active.trajectory is None:
            return
        at = active.waypoint
        if active.trajectory is not judged or at != judged_at:
            unchanged = unharmed is judged and at == judged_at
            self.judge_ahead(stamp_s, at if unchanged else None)
        self._judged = (active.trajectory, at)

    def judge_ahead(self, stamp_s: float, only: int | None = None) -> None:
        """Judge the active plan ahead. Drop or correct anomalous waypoints before they are used.

        Args:
            only: As for `Protection.ahead`.
        """
        active = self._pilot.active
        while (flown := active.trajectory) is not None:
            decision = self._protection.ahead(flown, active.waypoint, only, stamp_s)
            alarm = decision.alarm
            if decision.response is Response.HOLD:
                self._hold()
            elif decision.response is Response.RECOMPUTE and alarm is not None:
                if alarm.mended is not None:
                    self._replace(flown, alarm.mended)
                else:
                    assert alarm.waypoint is not None
                    self.drop(flown, alarm.waypoint)
                if alarm.stage is Stage.PLANNING:
                    self._pilot.want_plan()
                if active.trajectory is not flown:
                    continue
            return

    def drop(self, flown: Trajectory, waypoint: int) -> Trajectory:
        """Return `flown` without one waypoint. If `flown` is the active plan, replace that plan."""
        bridged = without_waypoint(flown, waypoint)
        self._replace(flown, bridged)
        return bridged

    def _replace(self, flown: Trajectory, mended: Trajectory) -> None:
        self._follower.withheld(flown)
        self._pilot.active.exchange(flown, mended)

    def _hold(self) -> None:
        if self.state is not None:
            self._pilot.abandon(self.state)
