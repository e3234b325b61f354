"""The companion computer: the pipeline's nodes wired together, one control tick at a time.

    depth frame -> point cloud -> OctoMap -> collision check -> pilot -> tracking -> setpoint
                                     |                            |  ^
                                     +------------> planner <-----+--+

Every message that one kernel hands to the next passes through one of the `_take_...` methods.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from mavfi_cli.autonomy import collision, occupancy, planning, point_cloud, smoothing, tracking
from mavfi_cli.autonomy.pilot import Directive, Mode, Pilot, PilotParams, PlanFailure, PlanRequest
from mavfi_cli.autonomy.planners import Planner
from mavfi_cli.autonomy.trajectory import waypoint_index
from mavfi_cli.core.seeds import Stream, derive
from mavfi_cli.core.states import of_stage
from mavfi_cli.core.types import (
    CollisionReport,
    Command,
    DepthFrame,
    PointCloud,
    Stage,
    Trajectory,
    VehicleState,
)
from mavfi_cli.core.wall import WallClock
from mavfi_cli.fi.source.activation import Follower
from mavfi_cli.fi.source.injector import Moment
from mavfi_cli.mission.briefing import Briefing
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.executor import Executor
from mavfi_cli.mission.injection import Injection, NoInjection
from mavfi_cli.mission.platform import LatencyModel, PlatformProfile

# A command computed within one physics step of the vehicle goes out in the tick of its state:
# a shorter delay is below what the simulation resolves.
SAME_TICK_S = 0.004
VERDICT_STATES = {state.name for state in of_stage(Stage.PERCEPTION)}
FOLLOWED_STATES = {s.name for s in of_stage(Stage.PLANNING) if s.name.startswith("waypoint_")}
PLAN_STATES = {s.name for s in of_stage(Stage.PLANNING)} - FOLLOWED_STATES
CHECKED_STATES = {*FOLLOWED_STATES, *PLAN_STATES} - {"waypoint_yaw"}
COMMAND_STATES = {state.name for state in of_stage(Stage.CONTROL)}
BRAKE_SHARE = 0.6  # of a_max that stopping counts on, as planned motion does


@dataclass(frozen=True, slots=True, kw_only=True)
class Reaction:
    """How long a depth frame took to reach a setpoint: the pipeline's response time."""

    frame_stamp_s: float
    setpoint_stamp_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _CheckInput:
    snapshot: occupancy.MapSnapshot
    trajectory: Trajectory | None
    time_s: float


class Companion:
    """Perception, planning and control of one mission."""

    def __init__(
        self,
        config: MissionConfig,
        platform: PlatformProfile,
        planner: Planner,
        briefing: Briefing,
        wall: WallClock,
        injection: Injection | NoInjection,
    ) -> None:
        self._config = config
        self._planner = planner
        self._injection = injection
        v_max, a_max = config.v_max_mps, config.a_max_mps2
        self.pilot = Pilot(
            PilotParams(
                goal_tolerance_m=config.goal_tolerance_m,
                v_max_mps=v_max,
                a_max_mps2=a_max,
                brake_mps2=BRAKE_SHARE * a_max,
            ),
            briefing.goal_enu_m,
        )
        self._cloud_params = point_cloud.PointCloudParams(max_range_m=config.map_range_m)
        self._map = occupancy.OccupancyMap(
            occupancy.OccupancyParams(
                resolution_m=config.map_resolution_m, max_range_m=config.map_range_m
            )
        )
        self._collision_params = collision.CollisionParams()
        self._collision_state = collision.CollisionState()
        self._planning_params = planning.StageParams(
            smoothing=smoothing.SmoothingParams(v_max_mps=v_max, a_max_mps2=a_max)
        )
        self._bounds_enu_m = briefing.bounds_enu_m
        self._tracking_params = tracking.TrackingParams(v_max_mps=v_max, a_max_mps2=a_max)
        self._tracking_state: tracking.TrackingState | None = None
        self._latency = LatencyModel(platform, config.seed)
        self.executor = Executor(
            draw_latency_s=self._latency.draw_s,
            cores=platform.cores,
            wall=wall,
            restart_s=config.node_restart_s,
            watchdog_s=config.node_watchdog_s,
        )
        add = self.executor.add
        add("point_cloud", self._run_point_cloud, self._take_cloud)
        add("octomap", self._run_octomap, self._take_snapshot)
        add("collision_check", self._run_collision_check, self._take_report)
        add("planner", self._run_planner, self._take_plan)
        self._control = add("control", self._run_control, lambda _output, _stamp_s: None)
        if injection.follower is not None:
            self.executor.on_start = self._on_start
        self._snapshot: occupancy.MapSnapshot | None = None
        self._checked: Trajectory | None = None
        self._commands: deque[tuple[float, Command]] = deque()  # (due stamp, command)
        self.report: CollisionReport | None = None
        self.command: Command | None = None
        self.directive: Directive | None = None
        self.plans: list[Trajectory] = []
        self.reactions: list[Reaction] = []
        self._fresh_frame_s: float | None = None
        self._takeover_s: float | None = None
        self._ticks = 0

    # Kernels as nodes run them: (input, start stamp) -> output

    def _run_point_cloud(self, frame: DepthFrame, _stamp_s: float) -> PointCloud:
        return point_cloud.generate(frame, self._cloud_params)

    def _run_octomap(self, cloud: PointCloud, _stamp_s: float) -> occupancy.MapSnapshot:
        self._map.insert(cloud)
        return self._map.snapshot()

    def _run_collision_check(
        self, check: _CheckInput, stamp_s: float
    ) -> tuple[CollisionReport, float]:
        inputs = collision.CollisionInputs(
            stamp_s=stamp_s,
            snapshot=check.snapshot,
            trajectory=check.trajectory,
            time_s=check.time_s,
        )
        self._collision_state, report = collision.step(
            self._collision_state, inputs, self._collision_params
        )
        return report, check.snapshot.stamp_s

    def _run_planner(
        self, job: tuple[PlanRequest, occupancy.MapSnapshot], stamp_s: float
    ) -> Trajectory | PlanFailure:
        request, snapshot = job
        found = planning.plan(
            self._planner,
            planning.StageInputs(
                snapshot=snapshot,
                position_enu_m=request.position_enu_m,
                departure=smoothing.Departure(
                    stamp_s=request.stamp_s,
                    velocity_enu_mps=request.velocity_enu_mps,
                    yaw_rad=request.yaw_rad,
                ),
                goal_enu_m=request.goal_enu_m,
                bounds_enu_m=self._bounds_enu_m,
                sequence=smoothing.Sequence(
                    trajectory_seq=_next_int32(request.trajectory_seq),
                    future_collision_seq=request.future_collision_seq,
                ),
                seed=derive(self._config.seed, Stream.PLANNER, request.attempt),
            ),
            self._planning_params,
        )
        if found.trajectory is None:
            return PlanFailure(stamp_s=request.stamp_s, reason=found.reason)
        return found.trajectory

    def _run_control(self, job: tuple[tracking.TrackingInputs, float], _stamp_s: float) -> Command:
        inputs, yaw_rad = job
        state = self._tracking_state
        if state is None:
            state = tracking.TrackingState(yaw_rad=yaw_rad, stamp_s=inputs.stamp_s)
        self._tracking_state, command = tracking.step(state, inputs, self._tracking_params)
        return command

    # Messages as they take effect

    def take_frame(self, frame: DepthFrame) -> None:
        """A new depth image has arrived."""
        self.executor.submit("point_cloud", frame)

    def _take_cloud(self, cloud: PointCloud, _stamp_s: float) -> None:
        self.executor.submit("octomap", cloud)

    def _take_snapshot(self, snapshot: occupancy.MapSnapshot, _stamp_s: float) -> None:
        self._snapshot = snapshot
        self._check()

    def _take_report(self, checked: tuple[CollisionReport, float], stamp_s: float) -> None:
        report, self._fresh_frame_s = checked
        self.report = self._injection.pass_on(report, self._moment(stamp_s))
        timely = self.pilot.on_report(self.report)
        if self._injection.follower is not None:
            states = VERDICT_STATES if timely else VERDICT_STATES - {"time_to_collision"}
            self._injection.follower.read(self.report, "mission logic", stamp_s, states)

    def _take_plan(self, result: Trajectory | PlanFailure, stamp_s: float) -> None:
        if isinstance(result, Trajectory):
            result = self._injection.pass_on(result, self._moment(stamp_s))
            self.plans.append(result)
            if self._injection.follower is not None:
                self._injection.follower.read(result, "mission logic", stamp_s, PLAN_STATES)
        self.pilot.on_plan(result)

    def _on_start(self, node: str, value: Any, start_s: float) -> None:
        """A node begins to work on its input: it has read it."""
        if node == "collision_check" and self._injection.follower is not None:
            self._injection.follower.read(value.trajectory, node, start_s, CHECKED_STATES)

    def _check(self) -> None:
        """Have the present trajectory checked against the newest map."""
        trajectory = self.pilot.trajectory
        if self._snapshot is None or trajectory is None:
            return
        self._checked = trajectory
        self.executor.submit(
            "collision_check",
            _CheckInput(snapshot=self._snapshot, trajectory=trajectory, time_s=self.pilot.time_s),
        )

    # The control tick

    @property
    def sees(self) -> bool:
        """Whether a map of what is ahead is there, so that planning makes sense."""
        return self._snapshot is not None

    def tick(self, stamp_s: float, state: VehicleState) -> Command | None:
        """One control tick in flight: the command that goes out now.

        `executor.advance(stamp_s)` comes before it and `executor.compute()` after it.
        """
        if self._takeover_s is None:
            self._takeover_s = stamp_s
        if not self.sees:
            return None
        self._ticks += 1
        if self.pilot.trajectory is not None:
            self._strike_latched(self.pilot.trajectory, stamp_s)
        directive = self.directive = self.pilot.update(stamp_s, state)
        if directive.plan is not None:
            assert self._snapshot is not None
            self.executor.submit("planner", (directive.plan, self._snapshot))
        if directive.trajectory is not None and directive.trajectory is not self._checked:
            self._check()
        delay_s = self._control_delay_s()
        if self._injection.follower is not None:
            self._follow(self._injection.follower, stamp_s, directive)
        command = self._track(stamp_s, state, directive)
        if command is not None:  # else the last one stays in force: the node is down
            self._commands.append((stamp_s + delay_s, command))
        while self._commands and self._commands[0][0] <= stamp_s:
            self._take_command(stamp_s, self._commands.popleft()[1])
        return self.command

    def _strike_latched(self, flown: Trajectory, stamp_s: float) -> None:
        """A fault in the memory of the flown trajectory; nobody is told, so no check follows."""
        struck = self._injection.strike_latched(flown, self._moment(stamp_s), self._waypoint())
        self.pilot.trajectory = struck
        if self._checked is flown:
            self._checked = struck

    def _follow(self, follower: Follower, stamp_s: float, directive: Directive) -> None:
        """Control is about to read the followed waypoint, and the yaw it turns to."""
        if not follower.waits:
            return
        if directive.trajectory is not None:
            at = max(0, waypoint_index(directive.trajectory, directive.time_s))
            follower.read(directive.trajectory, "control", stamp_s, FOLLOWED_STATES, at)
            follower.read(directive.trajectory, "control", stamp_s, {"waypoint_yaw"}, at + 1)
        follower.settle(lambda message: message is self.report or self.pilot.holds(message))

    def _track(self, stamp_s: float, state: VehicleState, directive: Directive) -> Command | None:
        inputs = tracking.TrackingInputs(
            stamp_s=stamp_s,
            position_enu_m=state.position_enu_m,
            velocity_enu_mps=state.velocity_enu_mps,
            trajectory=directive.trajectory,
            time_s=directive.time_s,
            rate=directive.rate,
            rate_change_per_s=directive.rate_change_per_s,
            hold_enu_m=directive.hold_enu_m,
            hold_yaw_rad=directive.hold_yaw_rad,
        )
        command: Command | None = self.executor.call("control", (inputs, state.yaw_rad), stamp_s)
        return command

    def _control_delay_s(self) -> float:
        latency_s = self._latency.draw_s("control")
        self._control.busy_s += latency_s
        return latency_s if latency_s >= SAME_TICK_S else 0.0

    def _take_command(self, stamp_s: float, command: Command) -> None:
        self.command = self._injection.pass_on(command, self._moment(stamp_s))
        if self._injection.follower is not None:
            self._injection.follower.read(self.command, "setpoint", stamp_s, COMMAND_STATES)
        if self._fresh_frame_s is not None:
            self.reactions.append(
                Reaction(frame_stamp_s=self._fresh_frame_s, setpoint_stamp_s=stamp_s)
            )
            self._fresh_frame_s = None

    def _moment(self, stamp_s: float) -> Moment:
        takeover_s = stamp_s if self._takeover_s is None else self._takeover_s
        return Moment(
            stamp_s=stamp_s,
            flight_s=stamp_s - takeover_s,
            tick=self._ticks,
            phase=self.pilot.mode.value,
        )

    def _waypoint(self) -> int:
        """Index of the waypoint that is followed at present."""
        assert self.pilot.trajectory is not None
        return max(0, waypoint_index(self.pilot.trajectory, self.pilot.time_s))

    @property
    def tracked(self) -> tuple[Trajectory, int] | None:
        """The tracked trajectory and the index of its present waypoint."""
        trajectory = self.pilot.trajectory
        if trajectory is None or not len(trajectory.waypoints):
            return None
        return trajectory, self._waypoint()

    @property
    def mode(self) -> Mode:
        """What the pilot is doing."""
        return self.pilot.mode

    def goal_distance_m(self, state: VehicleState) -> float:
        """Distance to the goal, m."""
        return float(np.linalg.norm(state.position_enu_m - self.pilot.goal_enu_m))


def _next_int32(value: int) -> int:
    """The next number of a 32-bit counter, which a fault may have driven to its end."""
    return (value + 1 + 2**31) % 2**32 - 2**31


def response_times(reactions: list[Reaction]) -> dict[str, float | None]:
    """Median and 95th percentile of the time from a depth frame to a setpoint, s."""
    if not reactions:
        return {"median": None, "p95": None, "count": 0}
    times = np.array([r.setpoint_stamp_s - r.frame_stamp_s for r in reactions])
    times = times[np.isfinite(times)]
    if not len(times):
        return {"median": None, "p95": None, "count": 0}
    return {
        "median": round(float(np.median(times)), 9),
        "p95": round(float(np.percentile(times, 95.0)), 9),
        "count": len(times),
    }
