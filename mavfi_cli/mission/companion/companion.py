"""The companion computer: connects the nodes of the pipeline and runs one control tick at a time.

    depth frame -> point cloud -> OctoMap -> collision check -> pilot -> tracking -> setpoint
                                     |                            |  ^
                                     +------------> planner <-----+--+

Every message between two kernels passes through one of the `_take_...` methods. `recovery` decides
what follows if the detector's gate withholds a message there.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from mavfi_cli.autonomy import occupancy
from mavfi_cli.autonomy.orders import Directive, PilotMode, PlanFailure
from mavfi_cli.autonomy.pilot import Pilot, PilotParams
from mavfi_cli.autonomy.planners import Planner
from mavfi_cli.autonomy.trajectory import waypoint_index
from mavfi_cli.core.states import of_stage
from mavfi_cli.core.types import (
    CollisionReport,
    Command,
    DepthFrame,
    FloatArray,
    PointCloud,
    Stage,
    Trajectory,
    VehicleState,
)
from mavfi_cli.core.wall import WallClock
from mavfi_cli.fi.source.activation import Follower
from mavfi_cli.fi.source.schedule import Moment
from mavfi_cli.mission.briefing import Briefing
from mavfi_cli.mission.companion.executor import Executor, Node
from mavfi_cli.mission.companion.kernels import CheckInput, ControlInput, Kernels, tracking_inputs
from mavfi_cli.mission.companion.protection import NoProtection
from mavfi_cli.mission.companion.recovery import Recovery, Retry, Setpoint
from mavfi_cli.mission.companion.response import Reaction
from mavfi_cli.mission.injection import NoInjection
from mavfi_cli.mission.latency import latency_model
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import PlatformProfile
from mavfi_cli.spec.stack import Stack

# A command computed within one physics step of the vehicle is sent in the tick of its state,
# because
# the simulation does not resolve shorter delays.
SAME_TICK_S = 0.004
VERDICT_STATES = {state.name for state in of_stage(Stage.PERCEPTION)}
FOLLOWED_STATES = {s.name for s in of_stage(Stage.PLANNING) if s.name.startswith("waypoint_")}
PLAN_STATES = {s.name for s in of_stage(Stage.PLANNING)} - FOLLOWED_STATES
CHECKED_STATES = {*FOLLOWED_STATES, *PLAN_STATES} - {"waypoint_yaw"}
COMMAND_STATES = {state.name for state in of_stage(Stage.CONTROL)}
BRAKE_SHARE = 0.6  # fraction of a_max assumed for stopping, as in planned motion


class Companion:
    """Perception, planning and control of one mission."""

    def __init__(
        self,
        config: MissionConfig,
        stack: Stack,
        platform: PlatformProfile,
        planner: Planner,
        briefing: Briefing,
        wall: WallClock,
        injection: NoInjection,
        protection: NoProtection,
    ) -> None:
        self._config = config
        self._stack = stack
        self._injection = injection
        self.protection = protection
        v_max, a_max = config.v_max_mps, config.a_max_mps2
        self.pilot = Pilot(
            PilotParams(
                goal_tolerance_m=stack.goal_tolerance_m,
                v_max_mps=v_max,
                a_max_mps2=a_max,
                brake_mps2=BRAKE_SHARE * a_max,
                guards_tracking=stack.guards_tracking,
                tracking_error_max_m=stack.tracking_guard_m,
                stops_on_report=stack.stops_on_report,
                uses_time_to_collision=stack.uses_time_to_collision,
                acts_on_report_once=stack.acts_on_report_once,
                owns_sequence_numbers=stack.owns_sequence_numbers,
                plans_in_motion=stack.plans_in_motion,
                arrives_at_rest=stack.arrives_at_rest,
                turns_before_departure=stack.turns_before_departure,
                rejected_plan_pause_s=stack.rejected_plan_pause_s,
                slows_where_blind=stack.slows_where_blind,
            ),
            briefing.goal_enu_m,
        )
        self._recovery = Recovery(
            protection, self.pilot, injection.follower, self._exchange, self._recompute_perception
        )
        self._latency = latency_model(platform, config.seed, wall)
        self.executor = Executor(
            draw_latency_s=self._latency.draw_s,
            cores=platform.cores,
            compute_first=platform.measured_factor is not None,
            wall=wall,
            restart_s=config.node_restart_s,
            watchdog_s=config.node_watchdog_s,
        )
        kernels = Kernels(config, stack, planner, briefing)
        add = self.executor.add
        add("point_cloud", kernels.point_cloud, self._take_cloud)
        add("octomap", kernels.octomap, self._take_snapshot, self._octomap_is_up)
        add("collision_check", kernels.collision_check, self._take_report)
        add("planner", kernels.planner, self._take_plan, self._planner_is_up)
        add("control", kernels.control, lambda _output, _stamp_s: None, self._control_is_up)
        for nodes in stack.processes:
            self.executor.share_process(nodes)
        if injection.follower is not None:
            self.executor.on_start = self._on_start
        self._snapshot: occupancy.MapSnapshot | None = None
        self._checked: Trajectory | None = None
        self._queued: Trajectory | None = None  # control's copy of the plan
        self._heard_seq = 0  # newest future_collision_seq known to the planner
        self._commands: deque[Setpoint] = deque()
        self._frame: DepthFrame | None = None
        self._state: VehicleState | None = None
        self.report: CollisionReport | None = None
        self.command: Command | None = None
        self.directive: Directive | None = None
        self.plans: list[Trajectory] = []
        self.reactions: list[Reaction] = []
        self._fresh_frame_s: float | None = None
        self._takeover_s: float | None = None
        self._ticks = 0

    @property
    def measured(self) -> dict[str, Any] | None:
        """Return factor and medians of a measured platform; None for any other."""
        return self._latency.summary()

    # Handlers of messages that take effect

    def take_frame(self, frame: DepthFrame) -> None:
        """Handle a new depth image."""
        self._frame = frame
        self.executor.submit("point_cloud", frame)

    def _take_cloud(self, cloud: PointCloud, _stamp_s: float) -> None:
        self.executor.submit("octomap", cloud)

    def _take_snapshot(self, snapshot: occupancy.MapSnapshot, stamp_s: float) -> None:
        self._snapshot = snapshot
        self._check(stamp_s)

    def _take_report(self, checked: tuple[CollisionReport, float], stamp_s: float) -> None:
        report, self._fresh_frame_s = checked
        moment = self._moment(stamp_s, foresees=report.collision)
        self._injection.watch(moment)
        report = self._injection.pass_on(report, moment)
        if not self._recovery.admit_report(report, stamp_s):
            return
        self.report = report
        if report.collision:
            self._heard_seq = max(self._heard_seq, report.future_collision_seq)
        timely = self.pilot.on_report(report)
        if self._injection.follower is not None:
            states = VERDICT_STATES if timely else VERDICT_STATES - {"time_to_collision"}
            self._injection.follower.read(report, "mission logic", stamp_s, states)

    def _recompute_perception(self) -> None:
        """Run point cloud, OctoMap and collision check again on the newest frame."""
        if self._frame is not None:
            self.executor.submit("point_cloud", self._frame)

    def _take_plan(self, result: Trajectory | PlanFailure, stamp_s: float) -> None:
        if isinstance(result, Trajectory):
            result = self._injection.pass_on(result, self._moment(stamp_s))
            if not self.pilot.expects(result):
                self.protection.lose_plan()
            elif not self._recovery.admit_plan(result, stamp_s):
                return
            self.plans.append(result)
            if self._injection.follower is not None:
                self._injection.follower.read(result, "mission logic", stamp_s, PLAN_STATES)
        else:
            self.protection.lose_plan()
        self.pilot.on_plan(result)

    def _planner_is_up(self, planner: Node) -> None:
        """Handle the planner's restart: repeat the lost request unless a newer one is waiting."""
        self._heard_seq = 0
        if planner.pending is None:
            self.pilot.plan_lost()

    def _octomap_is_up(self, octomap: Node) -> None:
        """Handle OctoMap's restart: nodes in its process have lost the map."""
        if octomap.mates:
            self._snapshot = occupancy.empty_snapshot(self._config.map_resolution_m)

    def _control_is_up(self, _control: Node) -> None:
        """Handle control's restart: if control owned its queue, the pilot requests a new plan."""
        if self._stack.control_owns_queue and self._state is not None:
            self._queued = None
            self.pilot.control_lost(self._state)

    def _on_start(self, node: str, value: Any, start_s: float) -> None:
        """Note that a node has read its input at the start of an invocation."""
        if node == "collision_check" and self._injection.follower is not None:
            self._injection.follower.read(value.trajectory, node, start_s, CHECKED_STATES)

    def _check(self, stamp_s: float) -> None:
        """Submit the present trajectory and the newest map to the collision check."""
        self._recovery.look_ahead(stamp_s)
        trajectory = self.pilot.active.trajectory
        if self._snapshot is None or trajectory is None:
            return
        self._checked = trajectory
        self.executor.submit(
            "collision_check",
            CheckInput(
                snapshot=self._snapshot,
                trajectory=trajectory,
                time_s=self.pilot.active.time_s,
                position_enu_m=self._front(),
            ),
        )

    def _front(self) -> FloatArray | None:
        """Return the position to which the check moves the path; None if it does not move."""
        if not self._stack.shifts_path_to_vehicle or self._state is None:
            return None
        return self._state.position_enu_m

    # The control tick

    @property
    def sees(self) -> bool:
        """True once there is a map, which planning needs."""
        return self._snapshot is not None

    def tick(self, stamp_s: float, state: VehicleState) -> Command | None:
        """Run one control tick in flight and return the command to send now.

        The caller must call `executor.advance(stamp_s)` before and `executor.compute()` after it.
        """
        if self._takeover_s is None:
            self._takeover_s = stamp_s
        if not self.sees:
            return None
        self._ticks += 1
        self._state = self._recovery.state = state
        self._injection.strike_memory(self._moment(stamp_s))
        copy = None
        if self.pilot.active.trajectory is not None:
            flown = self.pilot.active.trajectory
            copy = self._strike_latched(flown, stamp_s)
            self._recovery.look_round(stamp_s, flown)
        if self._injection.follower is not None:
            self._follow(self._injection.follower, stamp_s, copy)
        directive = self.directive = self.pilot.update(stamp_s, state)
        self._injection.watch(self._moment(stamp_s))
        if directive.plan is not None:
            assert self._snapshot is not None
            request = directive.plan
            if self._stack.owns_sequence_numbers:
                request = replace(request, future_collision_seq=self._heard_seq)
            self.executor.submit("planner", (request, self._snapshot))
        if directive.trajectory is not None and directive.trajectory is not self._checked:
            self._check(stamp_s)
        if copy is not None and directive.trajectory is not None:
            directive = replace(directive, trajectory=copy)
        setpoint = self._track(stamp_s, state, directive)
        if setpoint is not None:  # otherwise the node is busy or down, and the last command holds
            self._commands.append(setpoint)
        while self._commands and self._commands[0].due_s <= stamp_s:
            self._take_command(stamp_s, self._commands.popleft())
        return self.command

    def _strike_latched(self, flown: Trajectory, stamp_s: float) -> Trajectory | None:
        """Apply a fault to the memory of the active trajectory or to control's copy of it.

        If control owns its queue, its copy is the active trajectory, and control passes the rest of
        it to the other nodes. Otherwise the next tick replaces the copy.

        Returns:
            Trajectory that control uses in this tick instead of the active one; None if it is the
            same.
        """
        struck = self._injection.strike_latched(
            flown, self._moment(stamp_s), self.pilot.active.waypoint
        )
        if self._injection.in_queue and not self._stack.control_owns_queue:
            return None if struck is flown else struck
        self._exchange(flown, struck)
        return None

    def _exchange(self, flown: Trajectory, changed: Trajectory) -> None:
        """Replace the active plan by a changed version without a new collision check."""
        if self.pilot.active.trajectory is flown:
            self.pilot.active.trajectory = changed
        if self._checked is flown:
            self._checked = changed

    def _follow(self, follower: Follower, stamp_s: float, copy: Trajectory | None) -> None:
        """Note that mission logic and control read the present waypoint and the next yaw."""
        if not follower.waits:
            return
        flown = copy or self.pilot.active.trajectory
        if flown is not None:
            at = self.pilot.active.waypoint
            follower.read(flown, "control", stamp_s, FOLLOWED_STATES, at)
            follower.read(flown, "control", stamp_s, {"waypoint_yaw"}, at + 1)
        follower.settle(lambda m: m is self.report or m is copy or self.pilot.holds(m))

    def _track(
        self,
        stamp_s: float,
        state: VehicleState,
        directive: Directive,
        retry: Retry | None = None,
    ) -> Setpoint | None:
        """Start control's computation of a command, which is due after its latency."""
        fresh, attempt = (None, 0) if retry is None else (retry.fresh, retry.attempt)
        inputs = tracking_inputs(stamp_s, state, directive)
        goes_on = self._stack.control_owns_queue and directive.trajectory is self._queued
        if goes_on:
            inputs = replace(inputs, trajectory=None)
        job = ControlInput(inputs=inputs, goes_on=goes_on, fresh=fresh, yaw_rad=state.yaw_rad)
        called = self.executor.call("control", job, stamp_s, again=retry is not None)
        if called is None:
            return None
        self._queued = directive.trajectory
        command, latency_s = called
        frame_s, self._fresh_frame_s = self._fresh_frame_s, None
        flown = directive.trajectory
        return Setpoint(
            due_s=stamp_s + (latency_s if latency_s >= SAME_TICK_S else 0.0),
            command=command,
            directive=directive,
            waypoint=0 if flown is None else waypoint_index(flown, directive.time_s),
            attempt=attempt,
            frame_s=frame_s,
        )

    def _take_command(self, stamp_s: float, setpoint: Setpoint) -> None:
        """Pass a due command through the gate and send it.

        A withheld command is computed again, in the same tick if the platform is fast enough.
        """
        command = self._injection.pass_on(setpoint.command, self._moment(stamp_s))
        passes, retry = self._recovery.admit_command(command, setpoint, self.command, stamp_s)
        if not passes and self._fresh_frame_s is None:
            self._fresh_frame_s = setpoint.frame_s  # still without a setpoint
        if retry is not None:
            self._compute_again(stamp_s, retry)
        if not passes:
            return
        self.command = command
        self.pilot.active.pace = command.pace
        if command.skips_waypoint and setpoint.directive.trajectory is self.pilot.active.trajectory:
            self.pilot.active.skip_waypoint()
        if self._injection.follower is not None:
            self._injection.follower.read(command, "setpoint", stamp_s, COMMAND_STATES)
        if setpoint.frame_s is not None:
            self.reactions.append(
                Reaction(frame_stamp_s=setpoint.frame_s, setpoint_stamp_s=stamp_s)
            )

    def _compute_again(self, stamp_s: float, retry: Retry) -> None:
        assert self._state is not None
        renewed = self._track(stamp_s, self._state, retry.directive, retry)
        if renewed is None:
            return
        if renewed.due_s <= stamp_s:
            self._take_command(stamp_s, renewed)
        else:
            self._commands.append(renewed)

    def _moment(self, stamp_s: float, *, foresees: bool = False) -> Moment:
        takeover_s = stamp_s if self._takeover_s is None else self._takeover_s
        return Moment(
            stamp_s=stamp_s,
            flight_s=stamp_s - takeover_s,
            tick=self._ticks,
            phase=self.pilot.mode.value,
            foresees=foresees,
        )

    @property
    def tracked(self) -> tuple[Trajectory, int] | None:
        """Return the tracked trajectory and the index of its present waypoint."""
        trajectory = self.pilot.active.trajectory
        if trajectory is None or not len(trajectory.waypoints):
            return None
        return trajectory, self.pilot.active.waypoint

    @property
    def mode(self) -> PilotMode:
        """Present mode of the pilot."""
        return self.pilot.mode

    def goal_distance_m(self, state: VehicleState) -> float:
        """Return the distance to the goal, m."""
        return float(np.linalg.norm(state.position_enu_m - self.pilot.goal_enu_m))
