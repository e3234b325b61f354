"""The mission state machine. It decides when to plan, continue, slow down, stop and give up.

Its inputs are messages: collision reports, planned trajectories and the vehicle's state. Its output
is what to track (the trajectory, the point on it, the rate of its clock), and a request for a new
plan if one is needed.

A vehicle that plans in motion slows down and stops by slowing the trajectory's clock, so that it
stays on the checked path; see `_ActivePlan`. A vehicle that stops on a report drops the trajectory
and brakes, either at once or when the time to the collision requires it. A vehicle that does not
plan in motion comes to rest before it plans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mavfi_cli.autonomy.tracking import TrackingInputs, reference_waypoint, waypoint_index
from mavfi_cli.core.frames import norm, wrap_angle
from mavfi_cli.core.types import (
    CollisionReport,
    FloatArray,
    PilotCounters,
    Trajectory,
    VehicleState,
)


class PilotMode(Enum):
    """The mode of the pilot, which states what the vehicle is doing now."""

    TURNING = "turning"  # hovers and makes one full turn before the first plan
    WAITING = "waiting"  # hovers and waits for a plan
    FLYING = "flying"  # follows a trajectory without a predicted collision
    EVADING = "evading"  # follows a blocked trajectory at full speed while a new one is planned
    SLOWING = "slowing"  # follows a blocked trajectory at reduced speed, as there is less time
    STOPPING = "stopping"  # brakes, then plans from a hover
    ARRIVED = "arrived"
    GAVE_UP = "gave_up"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest:
    """Request for a trajectory from a state of motion to the goal."""

    stamp_s: float
    position_enu_m: FloatArray  # (3,)
    velocity_enu_mps: FloatArray  # (3,)
    yaw_rad: float
    goal_enu_m: FloatArray  # (3,)
    attempt: int  # number of the plan in the mission; seeds the planner
    trajectory_seq: int = 0  # newest number; the planner's node uses the next one
    future_collision_seq: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanFailure:
    """The planner's report that it found no trajectory."""

    stamp_s: float  # requested start of the trajectory
    reason: str


SPEED_MIN_MPS = 0.5  # lower limit of the speed from which the clock's ramp is computed
_SEVERITY = (PilotMode.FLYING, PilotMode.EVADING, PilotMode.SLOWING, PilotMode.STOPPING)
_DONE = (PilotMode.ARRIVED, PilotMode.GAVE_UP)
TURN_S = 6.0  # duration of one full turn; as in the released code with its two pauses of 1 s


@dataclass(frozen=True, slots=True, kw_only=True)
class PilotParams:
    """Limits, time-outs and rules by which the pilot flies a mission.

    v_max, a_max, the 0.25 s planning lead and the 40 attempts are those of the released
    package_delivery application (MAVBench/MAV_apps, branch mavfi).
    """

    v_max_mps: float = 3.0
    a_max_mps2: float = 5.0
    goal_tolerance_m: float = 1.0
    plan_lead_s: float = 0.25  # time from the request to the start of a plan made in flight
    late_plan_s: float = 0.5  # maximum delay of a plan after its own start
    brake_mps2: float = 3.0  # deceleration assumed for stopping
    margin_s: float = 0.4  # time added to braking before a predicted collision
    slow_rate: float = 0.5  # fraction of the planned speed while slowing
    attempts_max: int = 40  # consecutive failed plans before the mission is given up
    retry_s: float = 0.1  # pause after a failed plan
    look_round_after: int = 3  # consecutive failed plans before the vehicle makes one full turn
    guards_tracking: bool = True
    tracking_error_max_m: float = 2.0  # larger distance from the reference: stop and replan
    stops_on_report: bool = False  # a predicted collision ends the plan
    uses_time_to_collision: bool = True
    acts_on_report_once: bool = False
    owns_sequence_numbers: bool = False
    restores_counters: bool = False
    plans_in_motion: bool = True
    arrives_at_rest: bool = False
    turns_before_departure: bool = False
    rejected_plan_pause_s: float = 0.0
    slows_where_blind: bool = False
    sight_rad: float = math.pi / 4.0  # half the field of view that counts as seen; camera: 90 deg
    rest_mps: float = 0.3  # a slower vehicle counts as at rest
    start_error_max_m: float = 10.0  # maximum distance between a plan's start and the vehicle


class _ActivePlan:
    """The active trajectory, its clock, and the current point on it.

    The clock may run slower than simulated time to slow the vehicle down on the checked path. Its
    rate is ramped within the braking limit: along a path of planned speed v, a rate r gives the
    velocity r v, and a ramp dr/dt gives the acceleration v dr/dt.

    Attributes:
        trajectory: Active trajectory; None while hovering.
        time_s: Time on the trajectory, since its first waypoint.
        rate: Trajectory seconds per second, 0..1.
        rate_change_per_s: Time derivative of the rate.
        pace: Factor by which the current command slows the clock down, 0..1.
        checked: Trajectory that was last sent to the collision check.
    """

    def __init__(self, params: PilotParams) -> None:
        self._params = params
        self.checked: Trajectory | None = None
        self._located: tuple[Trajectory | None, float, int] = (None, 0.0, 0)
        self.stand()

    def stand(self) -> None:
        """Drop the trajectory and hover."""
        self.begin(None, time_s=0.0, rate=0.0)

    def begin(self, trajectory: Trajectory | None, *, time_s: float, rate: float) -> None:
        """Follow a trajectory, starting at its time `time_s`, with its clock at `rate`."""
        self.trajectory, self.time_s, self.rate = trajectory, time_s, rate
        self.rate_change_per_s, self.pace = 0.0, 1.0

    def advance(self, step_s: float, target_rate: float) -> None:
        """Advance the clock by `step_s` seconds, and ramp its rate towards `target_rate`."""
        speed = max(self._planned_speed_mps(), SPEED_MIN_MPS)
        ramp = self._params.brake_mps2 / speed * step_s
        change = min(max(target_rate - self.rate, -ramp), ramp)
        before = self.rate
        self.rate += change
        self.rate_change_per_s = change / step_s if step_s > 0.0 else 0.0
        self.time_s += 0.5 * (before + self.rate) * step_s * self.pace

    def exchange(self, flown: Trajectory, changed: Trajectory) -> None:
        """Replace `flown`, if it is active, with `changed`, without a new collision check."""
        if self.trajectory is flown:
            self.trajectory = changed
        if self.checked is flown:
            self.checked = changed

    def skip_waypoint(self) -> None:
        """Skip to the next waypoint, or to the end of the trajectory if there is none."""
        if self.trajectory is not None:
            durations_s = self.trajectory.durations_s[: self.waypoint + 1]
            self.time_s = float(durations_s[durations_s > 0.0].sum())

    @property
    def over(self) -> bool:
        """True if there is no trajectory, or if its end has passed. A NaN time counts as passed."""
        return self.trajectory is None or not self.time_s < self.trajectory.duration_s

    @property
    def waypoint(self) -> int:
        """Index of the current waypoint, or 0 without a trajectory."""
        return 0 if self.trajectory is None else self.waypoint_at(self.trajectory, self.time_s)

    def waypoint_at(self, trajectory: Trajectory, time_s: float) -> int:
        """Return the index of a trajectory's waypoint at `time_s`. The latest result is cached."""
        known, known_s, index = self._located
        if trajectory is not known or time_s != known_s:
            index = waypoint_index(trajectory, time_s)
            self._located = trajectory, time_s, index
        return index

    def reference(self, ahead_s: float = 0.0) -> FloatArray:
        """Return the reference (10,), in the order of WAYPOINT_FIELDS, `ahead_s` from now.

        The clock is assumed to keep its rate. Velocity and acceleration are those at rate 1.
        """
        assert self.trajectory is not None
        return reference_waypoint(self.trajectory, self.time_s + self.rate * ahead_s)

    def _planned_speed_mps(self) -> float:
        """Return the planned speed at the current point at rate 1, limited to v_max."""
        speed, limit = norm(self.reference()[4:7]), self._params.v_max_mps
        return min(speed, limit) if math.isfinite(speed) else limit

    def stopping_s(self) -> float:
        """Return the time in seconds to brake from the current speed to rest."""
        return self.rate * self._planned_speed_mps() / self._params.brake_mps2


class Pilot:
    """The mission state machine. Pass it every message, then call `update` once per control tick.

    Attributes:
        active: Active trajectory and the current point on it.
    """

    def __init__(self, params: PilotParams, goal_enu_m: FloatArray) -> None:
        self.params = params
        self.goal_enu_m = goal_enu_m
        self.counters = PilotCounters()
        self.mode = PilotMode.WAITING
        self.active = _ActivePlan(params)
        self._next: Trajectory | None = None
        self._hold: FloatArray | None = None
        self._hold_yaw = 0.0
        self._trajectory_seq = 0
        self._collision_seq = 0
        self._awaiting_plan = False
        self._requested_s = 0.0  # start of the requested plan
        self._requested_rate = 1.0  # rate of the clock at the request
        self._abandoned: set[float] = set()  # starts of requested plans that are no longer needed
        self._adopted = False  # True once any plan has been adopted
        self._wanted = True
        self._not_before_s = 0.0
        self._failures = 0
        self._stamp_s = 0.0
        self._look_started_s: float | None = None
        self._stop_s = math.inf  # time at which a report stops the vehicle

    @np.errstate(over="ignore", invalid="ignore")
    def on_report(self, report: CollisionReport) -> bool:
        """Handle a collision report. Return True if the pilot read its time to collision.

        A report whose future_collision_seq is lower than the newest one is ignored.
        """
        if report.future_collision_seq < self._collision_seq:
            self.counters.reports_ignored += 1
            return False
        if not report.collision or self.active.trajectory is None:
            return False
        if report.future_collision_seq > self._collision_seq:
            self.counters.collisions_foreseen += 1
        elif self.params.acts_on_report_once:
            return False
        self._collision_seq = report.future_collision_seq
        if self.mode in (*_DONE, PilotMode.WAITING):
            return False
        self._next = None
        self.want_plan()
        self._react(report)
        return self.params.uses_time_to_collision

    def holds(self, trajectory: object) -> bool:
        """Return True if this trajectory is the active one, or the next one to follow."""
        return trajectory is not None and (
            trajectory is self.active.trajectory or trajectory is self._next
        )

    def _react(self, report: CollisionReport) -> None:
        """Continue, slow down or stop, depending on the time to the collision."""
        p = self.params
        left_s = 0.0
        if p.uses_time_to_collision:
            left_s = report.time_to_collision_s - (self._stamp_s - report.stamp_s)
        brake_s = self.active.stopping_s() + p.margin_s
        if p.stops_on_report:
            self._stop_s = self._stamp_s + (left_s - brake_s if left_s > brake_s else 0.0)
            return
        mode = PilotMode.EVADING
        if not left_s > brake_s:  # also stops on NaN
            mode = PilotMode.STOPPING
        elif left_s <= brake_s + p.plan_lead_s + p.late_plan_s:
            mode = PilotMode.SLOWING
        if _SEVERITY.index(mode) > _SEVERITY.index(self.mode):
            if mode is PilotMode.STOPPING:
                self._brake()
                self._plan_anew()
            self.counters.slowdowns += mode is PilotMode.SLOWING
            self.mode = mode

    def _brake(self) -> None:
        self.counters.stops += self.mode is not PilotMode.STOPPING
        self.mode = PilotMode.STOPPING

    def _plan_anew(self) -> None:
        """Request a plan, and abandon any pending request, because its start is no longer valid."""
        self._wanted = True
        if self._awaiting_plan:
            self._awaiting_plan = False
            self._abandoned.add(self._requested_s)

    def on_plan(self, result: Trajectory | PlanFailure) -> None:
        """Handle a plan or a failure to plan.

        A trajectory is ignored if it is out of order, was planned before the newest predicted
        collision, does not begin at the requested time, or arrives too late for its own start. The
        result of an abandoned request is also ignored.
        """
        if not self.expects(result):
            self._abandoned.discard(result.stamp_s)
            self.counters.plans_ignored += 1
            return
        self._awaiting_plan = False
        if isinstance(result, PlanFailure):
            self._plan_failed()
            return
        p = self.params
        stale = not self._is_new(result) or result.stamp_s != self._requested_s
        late = self.active.rate > 0.0 and self._stamp_s - result.stamp_s > p.late_plan_s
        if stale or late:
            self.counters.plans_ignored += 1
            self._wanted = True
            self._not_before_s = max(self._not_before_s, self._stamp_s + p.rejected_plan_pause_s)
            if late:
                self._brake()
            return
        self._failures = 0
        self._look_started_s = None
        self._trajectory_seq = result.trajectory_seq
        self._collision_seq = max(self._collision_seq, result.future_collision_seq)
        self._next = result

    def _is_new(self, plan: Trajectory) -> bool:
        """Return True if a plan is new and accounts for the newest predicted collision.

        A pilot that owns its numbers stores a plan's trajectory_seq before it checks the plan's
        future_collision_seq, as the released follow_trajectory.cpp does.
        """
        if not self.params.owns_sequence_numbers:
            newer = plan.trajectory_seq > self._trajectory_seq
        elif newer := plan.trajectory_seq >= self._trajectory_seq:
            self._trajectory_seq = plan.trajectory_seq
        return newer and plan.future_collision_seq >= self._collision_seq

    def expects(self, result: Trajectory | PlanFailure) -> bool:
        """Return True if a result answers the pending request."""
        return self._awaiting_plan and result.stamp_s not in self._abandoned

    def reject_plan(self) -> None:
        """Reject the requested plan, which a detector has withheld, and request another."""
        self.counters.plans_rejected += 1
        self.plan_lost()

    def plan_lost(self) -> None:
        """Request another plan if one is pending, because the pending one will not arrive."""
        if self._awaiting_plan:
            self._awaiting_plan = False
            self._wanted = True

    def want_plan(self) -> None:
        """Request a new plan unless one is pending."""
        if not self._awaiting_plan and self.mode not in _DONE:
            self._wanted = True

    def _plan_failed(self) -> None:
        self.counters.plans_failed += 1
        self._failures += 1
        self._wanted = True
        self._not_before_s = self._stamp_s + self.params.retry_s
        if self.mode in _DONE:
            return
        if self.active.trajectory is not None:
            self._brake()
        if self._failures >= self.params.attempts_max:
            self.mode = PilotMode.GAVE_UP
        elif self._failures == self.params.look_round_after:
            self._look_started_s = self._stamp_s
            self.counters.look_rounds += 1

    @np.errstate(over="ignore", invalid="ignore")  # waypoints may be corrupted
    def update(
        self, stamp_s: float, state: VehicleState
    ) -> tuple[TrackingInputs, PlanRequest | None]:
        """Run one control tick: advance along the trajectory and return what to track.

        Returns:
            The inputs of control, and a request if a plan is needed, otherwise None.
        """
        step_s = stamp_s - self._stamp_s if self._stamp_s else 0.0
        self._stamp_s = stamp_s
        if self._hold is None:
            self._hold_here(state)
            if self.params.turns_before_departure:
                self.mode, self._look_started_s = PilotMode.TURNING, stamp_s
        if self.mode not in _DONE:
            if self.mode is PilotMode.TURNING and self._look_s >= TURN_S:
                self.mode, self._look_started_s = PilotMode.WAITING, None
            if not stamp_s < self._stop_s:
                self._stop_s = math.inf
                if self.active.trajectory is not None:
                    self.abandon(state)
            self._advance(step_s, state)
            self._settle(state)
            self._adopt_next()
            self._guard(state)
            if self._has_arrived(state):
                self.mode = PilotMode.ARRIVED
                self._hold, self._hold_yaw = self.goal_enu_m, state.yaw_rad
                self.active.stand()
        request = self._plan_request(state)
        turned_rad = 0.0
        if self.mode in (PilotMode.WAITING, PilotMode.TURNING):
            turned_rad = min(2.0 * math.pi, self._look_s * 2.0 * math.pi / TURN_S)
        assert self._hold is not None
        tracked = TrackingInputs(
            stamp_s=stamp_s,
            position_enu_m=state.position_enu_m,
            velocity_enu_mps=state.velocity_enu_mps,
            trajectory=self.active.trajectory,
            time_s=self.active.time_s,
            rate=self.active.rate,
            rate_change_per_s=self.active.rate_change_per_s,
            hold_enu_m=self._hold,
            hold_yaw_rad=self._hold_yaw + turned_rad,
        )
        return tracked, request

    @property
    def _look_s(self) -> float:
        """Time in seconds since the vehicle began its full turn, or 0 if it is not turning."""
        return 0.0 if self._look_started_s is None else self._stamp_s - self._look_started_s

    def _has_arrived(self, state: VehicleState) -> bool:
        at_goal = norm(state.position_enu_m - self.goal_enu_m) <= self.params.goal_tolerance_m
        rests = self.active.trajectory is None and self._at_rest(state)
        return at_goal and (rests or not self.params.arrives_at_rest)

    def _at_rest(self, state: VehicleState) -> bool:
        return norm(state.velocity_enu_mps) <= self.params.rest_mps

    def _hover(self, state: VehicleState) -> None:
        """Drop the trajectory and hover here, or where the vehicle comes to rest."""
        self._hold_here(state)
        self.active.stand()
        self._next = None
        self.mode = PilotMode.WAITING if self.params.plans_in_motion else PilotMode.STOPPING

    def _settle(self, state: VehicleState) -> None:
        """Move the hover position with the vehicle while it brakes without a trajectory."""
        if self.mode is PilotMode.STOPPING and self.active.trajectory is None:
            self._hold_here(state)
            if self._at_rest(state):
                self.mode = PilotMode.WAITING

    def _adopt_next(self) -> None:
        """Switch to the next trajectory once its start time is reached."""
        if self._next is None or self._stamp_s < self._next.stamp_s:
            return
        self.counters.replans += self._adopted
        self._adopted = True
        moving = self.mode not in (PilotMode.WAITING, PilotMode.STOPPING)
        late_s = self._stamp_s - self._next.stamp_s
        self.active.begin(
            self._next,
            time_s=max(0.0, late_s) if moving else 0.0,
            # The plan's initial velocity includes the clock's rate at the request: divide by it.
            rate=min(1.0, self.active.rate / self._requested_rate) if moving else 1.0,
        )
        self._next = None
        self._stop_s = math.inf
        self.mode = PilotMode.FLYING

    def _advance(self, step_s: float, state: VehicleState) -> None:
        """Run the trajectory's clock at the rate of the mode.

        Once the trajectory is over or its clock has stopped, hover and request a plan.
        """
        if self.active.trajectory is None:
            return
        slower = {PilotMode.STOPPING: 0.0, PilotMode.SLOWING: self.params.slow_rate}
        rate = slower.get(self.mode, 1.0)
        if self.params.slows_where_blind and self._flies_blind(state):
            rate = min(rate, self.params.slow_rate)
        self.active.advance(step_s, rate)
        stopped = self.mode is PilotMode.STOPPING and self.active.rate <= 0.0
        if not (stopped or (self.active.over and self._next is None)):
            return
        self.want_plan()
        if not self.params.plans_in_motion:
            self._hover(state)
            return
        reference = self.active.reference()
        self._hold, self._hold_yaw = reference[0:3].copy(), float(reference[3])
        self.active.stand()
        self.mode = PilotMode.WAITING

    def _flies_blind(self, state: VehicleState) -> bool:
        """Return True if the direction of flight is outside the camera's field of view."""
        east, north = self.active.reference()[4:6]
        if not math.hypot(east, north) > self.params.rest_mps:
            return False
        return abs(wrap_angle(math.atan2(north, east) - state.yaw_rad)) > self.params.sight_rad

    def _guard(self, state: VehicleState) -> None:
        """Stop and replan from here if the vehicle is too far from the reference."""
        if self.active.trajectory is None or not self.params.guards_tracking:
            return
        error_m = norm(state.position_enu_m - self.active.reference()[0:3])
        if not error_m <= self.params.tracking_error_max_m:
            self.abandon(state)

    def control_lost(self, state: VehicleState) -> None:
        """Handle a restart of control: its queue is empty, and its counters are 0 or restored."""
        if self.params.owns_sequence_numbers and not self.params.restores_counters:
            self._trajectory_seq = self._collision_seq = 0
        if self.active.trajectory is not None:
            self.abandon(state)

    def abandon(self, state: VehicleState) -> None:
        """Drop the trajectory, hover here, and request a plan from here."""
        if self.mode in _DONE:
            return
        self._hover(state)
        self._plan_anew()
        self.counters.stops += 1

    def _hold_here(self, state: VehicleState) -> None:
        self._hold = state.position_enu_m.copy()
        self._hold_yaw = state.yaw_rad

    def _plan_request(self, state: VehicleState) -> PlanRequest | None:
        """Return a request for a plan, or None if no request is due.

        A request is due if a plan is wanted, none is pending, the pause is over and the mode allows
        planning.
        """
        idle = self.mode in (*_DONE, PilotMode.STOPPING, PilotMode.TURNING)
        if not self.params.plans_in_motion:
            idle = idle or self.active.trajectory is not None or not self._at_rest(state)
        if idle or not self._wanted or self._awaiting_plan or self._stamp_s < self._not_before_s:
            return None
        self._wanted = False
        self._awaiting_plan = True
        self.counters.plans_requested += 1
        flying = self.active.trajectory is not None
        self._requested_s = self._stamp_s + (self.params.plan_lead_s if flying else 0.0)
        self._requested_rate = self.active.rate or 1.0
        position, velocity, yaw_rad = self._start_of_plan(state)
        return PlanRequest(
            stamp_s=self._requested_s,
            position_enu_m=position.copy(),
            velocity_enu_mps=velocity,
            yaw_rad=yaw_rad,
            goal_enu_m=self.goal_enu_m,
            attempt=self.counters.plans_requested,
            trajectory_seq=self._trajectory_seq,
            future_collision_seq=self._collision_seq,
        )

    def _start_of_plan(self, state: VehicleState) -> tuple[FloatArray, FloatArray, float]:
        """Return position, velocity and yaw at the start of the next trajectory."""
        if self.active.trajectory is None:
            assert self._hold is not None
            start = self._hold if self._near(self._hold, state) else state.position_enu_m
            return start, np.zeros(3), state.yaw_rad
        waypoint = self.active.reference(self.params.plan_lead_s)
        if not self._near(waypoint[0:3], state):
            return state.position_enu_m, np.zeros(3), state.yaw_rad
        return waypoint[0:3], self.active.rate * waypoint[4:7], float(waypoint[3])

    def _near(self, place_enu_m: FloatArray, state: VehicleState) -> bool:
        """Return True if a plan may begin at this position (3,), which may be corrupted."""
        return norm(place_enu_m - state.position_enu_m) <= self.params.start_error_max_m
