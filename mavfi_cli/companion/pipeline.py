"""The companion computer: from a depth frame to a setpoint, in the order of the methods below.

    depth frame -> point cloud -> OctoMap -> collision check -> pilot -> tracking -> setpoint
                                     |                            |  ^
                                     +------------> planner <-----+--+

A line `output = self.publish(await self._node.run(value))` submits the value to a node and
continues after the node's latency in simulated time. Every output passes through `publish`, where a
fault may strike it and the detector may withhold it. A withheld message ends the turn.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import TypeVar

from mavfi_cli.autonomy import planners
from mavfi_cli.autonomy.collision import CollisionInputs
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import Pilot, PilotParams, PlanRequest
from mavfi_cli.autonomy.tracking import TrackingInputs, TrackingState
from mavfi_cli.companion.executor import Executor, LatencyModel, Node, TurnOver
from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.kernels import ControlInput, Kernels
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.companion.protection import PASSED, Decision, NoProtection, Recovery, Response
from mavfi_cli.core.types import (
    Briefing,
    CollisionReport,
    Command,
    DepthFrame,
    Message,
    PointCloud,
    Reaction,
    Stage,
    Trajectory,
    VehicleState,
)
from mavfi_cli.core.wall import WallClock
from mavfi_cli.fi.injector import Moment
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import PlatformProfile, load_platform
from mavfi_cli.spec.stack import Stack

M = TypeVar("M", PointCloud, MapSnapshot, CollisionReport, Trajectory, Command)

# A command computed within one physics step of the vehicle is sent in the tick of its state,
# because the simulation does not resolve shorter delays.
SAME_TICK_S = 0.004
ATTEMPTS = 2  # maximum recomputations of a command in one tick
BRAKE_SHARE = 0.6  # fraction of a_max assumed for stopping, as in planned motion

# Monitored states that the receivers of a message read.
REPORT_STATES = {state.name for state in Stage.PERCEPTION.states}
COMMAND_STATES = {state.name for state in Stage.CONTROL.states}
FOLLOWED_STATES = {s.name for s in Stage.PLANNING.states if s.name.startswith("waypoint_")}
PLAN_STATES = {s.name for s in Stage.PLANNING.states} - FOLLOWED_STATES
CHECKED_STATES = {*FOLLOWED_STATES, *PLAN_STATES} - {"waypoint_yaw"}


class _Withheld(TurnOver):
    """Raised to end a turn when the detector withholds a message."""

    def __init__(self, decision: Decision) -> None:
        super().__init__()
        self.decision = decision


@dataclass(frozen=True, slots=True, kw_only=True)
class _Setpoint:
    """A command that control has computed, and the inputs from which it was computed."""

    due_s: float  # end of control's computation
    command: Command
    inputs: TrackingInputs
    waypoint: int  # index in the trajectory of the inputs
    attempt: int  # number of recomputations
    frame_s: float | None  # stamp of a depth frame that no earlier command has used


@dataclass(frozen=True, slots=True, kw_only=True)
class CompanionParts:
    """The stack, platform and planner of a mission."""

    stack: Stack
    platform: PlatformProfile
    planner: planners.Planner

    @classmethod
    def of(cls, config: MissionConfig) -> CompanionParts:
        """Load the stack, platform and planner that a mission names.

        Raises:
            UnknownName: One of them does not exist.
            ConfigError: The file of one of them cannot be used.
        """
        return cls(
            planner=planners.find(config.planner),
            platform=load_platform(config.platform),
            stack=config.loaded_stack(),
        )


class Companion:
    """The companion of one mission: perception, planning and control.

    Attributes:
        plan_failures: Number of failed plans for each reason that the planner gave.
        reactions: Stamps of depth frames, each with the stamp of the first setpoint that depends
            on the frame.
    """

    def __init__(
        self,
        config: MissionConfig,
        parts: CompanionParts,
        briefing: Briefing,
        wall: WallClock,
        injection: NoInjection,
        protection: NoProtection,
    ) -> None:
        stack, platform = parts.stack, parts.platform
        self._config, self._stack = config, stack
        self._injection, self._injector = injection, injection.injector
        self._follower = injection.injector.follower
        self.protection = protection
        pilot_params = PilotParams(
            v_max_mps=config.v_max_mps,
            a_max_mps2=config.a_max_mps2,
            brake_mps2=BRAKE_SHARE * config.a_max_mps2,
            tracking_error_max_m=stack.tracking_guard_m,
            **stack.settings_of(PilotParams),
        )
        self.pilot = Pilot(pilot_params, briefing.goal_enu_m)
        self._recovery = Recovery(protection, self.pilot, self._follower, self._see_again)
        self.latency = LatencyModel(platform, config.seed, wall)
        self.executor = Executor(
            draw_latency_s=self.latency.draw_s,
            cores=platform.cores,
            compute_first=platform.measured_factor is not None,
            wall=wall,
            restart_s=config.node_restart_s,
            watchdog_s=config.node_watchdog_s,
        )
        kernels, add = Kernels(config, stack, parts.planner, briefing), self.executor.add
        self._point_cloud = add(Node("point_cloud", kernels.point_cloud))
        self._octomap = add(Node("octomap", kernels.octomap, on_restart=self._octomap_is_up))
        self._collision_check = add(
            Node("collision_check", kernels.collision_check, on_start=self._check_starts)
        )
        self._planner = add(Node("planner", kernels.planner, on_restart=self._planner_is_up))
        self._fresh = kernels  # with which a lost process restarts
        if stack.restores_counters:
            self._collision_check.before_restart = lambda: self._fresh.restore_check(self.report)
            self._planner.before_restart = lambda: self._fresh.restore_planner(self.plans)
        self._control = add(Node("control", kernels.control, on_restart=self._control_is_up))
        for nodes in stack.processes:
            self.executor.share_process(nodes)
        self.executor.stand_by(stack.standby)
        self._frame: DepthFrame | None = None
        self._map: MapSnapshot | None = None
        self._heard_seq = 0  # newest future_collision_seq that reached the planner
        self._queued: Trajectory | None = None  # control's copy of the plan
        self._setpoints: deque[_Setpoint] = deque()  # computed, not yet due
        self._state: VehicleState | None = None
        self._fresh_frame_s: float | None = None
        self._takeover_s: float | None = None
        self._ticks = 0
        self.report: CollisionReport | None = None
        self.command: Command | None = None
        self.plans: list[Trajectory] = []
        self.plan_failures: Counter[str] = Counter()
        self.reactions: list[Reaction] = []

    def isolate_late(self, name: str, fresh: Companion, process: NodeProcess | None = None) -> None:
        """Move a node that has already run to its own process, as `Executor.isolate_late` does.

        Args:
            fresh: A companion that has never run. If the process is lost, its kernels take over.
        """
        self.executor.isolate_late(name, fresh.executor.process_of(name), process)
        self._fresh = fresh._fresh

    # Perception

    def take_frame(self, frame: DepthFrame) -> None:
        """Start perception of a new depth frame."""
        self._frame = frame
        self.executor.start(self._see(frame))

    async def _see(self, frame: DepthFrame) -> None:
        """Add a depth frame to the map, and check the active plan against the new map."""
        cloud = self.publish(await self._point_cloud.run(frame))
        self._map = self.publish(await self._octomap.run(cloud))
        await self._check()

    async def _check(self) -> None:
        """Check the rest of the active plan against the newest map, and report to the pilot."""
        self._recovery.judge_ahead(self._now_s)
        active, snapshot = self.pilot.active, self._map
        if snapshot is None or active.trajectory is None:
            return
        active.checked = active.trajectory
        moved_to = self._state if self._stack.shifts_path_to_vehicle else None
        inputs = CollisionInputs(
            stamp_s=self._now_s,
            snapshot=snapshot,
            trajectory=active.trajectory,
            time_s=active.time_s,
            front_enu_m=None if moved_to is None else moved_to.position_enu_m,
        )
        report = await self._collision_check.run(inputs)
        self._fresh_frame_s = snapshot.stamp_s
        self.report = report = self.publish(report)
        if report.collision:
            self._heard_seq = max(self._heard_seq, report.future_collision_seq)
        timely = self.pilot.on_report(report)
        read = REPORT_STATES if timely else REPORT_STATES - {"time_to_collision"}
        self._follower.read(report, "mission logic", self._now_s, read)

    def _see_again(self) -> None:
        """Repeat perception of the newest depth frame."""
        if self._frame is not None:
            self.executor.start(self._see(self._frame))

    # Planning

    async def _plan(self, request: PlanRequest) -> None:
        """Plan a trajectory on the newest map, and pass it to the pilot."""
        assert self._map is not None
        if self._stack.owns_sequence_numbers:
            request = replace(request, future_collision_seq=self._heard_seq)
        result = await self._planner.run((request, self._map))
        if isinstance(result, Trajectory):
            result = self.publish(result)
            self.plans.append(result)
            self._follower.read(result, "mission logic", self._now_s, PLAN_STATES)
        else:
            self.plan_failures[result.reason] += 1
            self.protection.lose_plan()
        self.pilot.on_plan(result)

    # Control

    def tick(self, state: VehicleState) -> Command | None:
        """Run one control tick in flight. Return the command to send now, or None before the first.

        The caller must call `executor.advance` before and `executor.compute` after it.
        """
        if self._takeover_s is None:
            self._takeover_s = self._now_s
        if self._map is None:  # planning needs a map
            return None
        self._ticks += 1
        self._state = self._recovery.state = state
        copy = self._strike_memory()
        inputs, request = self.pilot.update(self._now_s, state)
        self._injector.watch(self._moment())
        if request is not None:
            self.executor.start(self._plan(request))
        if inputs.trajectory is not None:
            if inputs.trajectory is not self.pilot.active.checked:
                self.executor.start(self._check())
            if copy is not None:
                inputs = replace(inputs, trajectory=copy)
        setpoint = self._track(inputs)
        if setpoint is not None:  # otherwise the node is busy or down, and the last command holds
            self._setpoints.append(setpoint)
        while self._setpoints and self._setpoints[0].due_s <= self._now_s:
            self._send(self._setpoints.popleft())
        return self.command

    def _track(
        self, inputs: TrackingInputs, attempt: int = 0, fresh: TrackingState | None = None
    ) -> _Setpoint | None:
        """Compute a command, due after control's latency. Return None if control is busy or down.

        Args:
            fresh: State from which the controller starts. If None, it continues from its own.
        """
        assert self._state is not None
        followed = inputs.trajectory
        goes_on = self._stack.control_owns_queue and followed is self._queued
        job = ControlInput(
            inputs=replace(inputs, trajectory=None) if goes_on else inputs,
            goes_on=goes_on,
            fresh=fresh,
            yaw_rad=self._state.yaw_rad,
        )
        called = self.executor.call(self._control, job, again=attempt > 0)
        if called is None:
            return None
        self._queued = followed
        command, latency_s = called
        frame_s, self._fresh_frame_s = self._fresh_frame_s, None
        return _Setpoint(
            due_s=self._now_s + (latency_s if latency_s >= SAME_TICK_S else 0.0),
            command=command,
            inputs=inputs,
            waypoint=0
            if followed is None
            else self.pilot.active.waypoint_at(followed, inputs.time_s),
            attempt=attempt,
            frame_s=frame_s,
        )

    def _send(self, setpoint: _Setpoint) -> None:
        try:
            command = self.command = self.publish(setpoint.command, setpoint)
        except _Withheld as withheld:
            self._track_again(setpoint, withheld.decision)
            return
        active = self.pilot.active
        active.pace = command.pace
        if command.skips_waypoint and setpoint.inputs.trajectory is active.trajectory:
            active.skip_waypoint()
        self._follower.read(command, "setpoint", self._now_s, COMMAND_STATES)
        if setpoint.frame_s is not None:
            self.reactions.append(
                Reaction(frame_stamp_s=setpoint.frame_s, setpoint_stamp_s=self._now_s)
            )

    def _track_again(self, setpoint: _Setpoint, decision: Decision) -> None:
        """Recompute a withheld command, in this tick if the platform is fast enough.

        If a recomputation did not help, or the waypoint is at fault, drop the waypoint and start
        from a fresh state. After ATTEMPTS unsuccessful recomputations, the last command holds until
        the next tick.
        """
        if self._fresh_frame_s is None:
            self._fresh_frame_s = setpoint.frame_s  # no setpoint has used it yet
        if decision.response is Response.HOLD or setpoint.attempt >= ATTEMPTS:
            return
        assert self._state is not None
        inputs, fresh, last = setpoint.inputs, None, self.command
        if decision.blames(Stage.PLANNING) or setpoint.attempt > 0:
            if inputs.trajectory is not None:
                bridged = self._recovery.drop(inputs.trajectory, setpoint.waypoint)
                inputs = replace(inputs, trajectory=bridged)
            if last is not None:
                fresh = TrackingState(yaw_rad=last.yaw_rad, stamp_s=last.stamp_s)
        inputs = replace(
            inputs,
            stamp_s=self._now_s,
            position_enu_m=self._state.position_enu_m,
            velocity_enu_mps=self._state.velocity_enu_mps,
        )
        renewed = self._track(inputs, setpoint.attempt + 1, fresh)
        if renewed is None:
            return
        if renewed.due_s <= self._now_s:
            self._send(renewed)
        else:
            self._setpoints.append(renewed)

    # Every message

    def publish(self, message: M, setpoint: _Setpoint | None = None) -> M:
        """Pass a kernel's output to its receivers. Return the version that they receive.

        Raises:
            TurnOver: The detector withholds the message. Its recovery has begun.
        """
        moment = self._moment(foresees=isinstance(message, CollisionReport) and message.collision)
        if isinstance(message, CollisionReport):
            self._injector.watch(moment)
        message = self._injector.pass_on(message, moment)
        if isinstance(message, Message):  # clouds and maps contain no monitored state
            decision = self._judge(message, setpoint)
            if decision.withheld:
                self._recovery.recover(message, decision)
                raise _Withheld(decision)
        return message

    def _judge(self, message: Message, setpoint: _Setpoint | None) -> Decision:
        """Have the detector judge a message. A plan that is no longer needed is not judged."""
        if isinstance(message, CollisionReport):
            return self.protection.report(message, self._now_s)
        if isinstance(message, Command):
            assert setpoint is not None
            followed = setpoint.inputs.trajectory
            return self.protection.tick(followed, setpoint.waypoint, message, self._now_s)
        if self.pilot.expects(message):
            return self.protection.plan(message, self._now_s)
        self.protection.lose_plan()
        return PASSED

    def _strike_memory(self) -> Trajectory | None:
        """Let a fault strike memory, then have the detector judge the active plan before its use.

        Return control's copy of the plan, to be used in this tick only, if the fault corrupted just
        this copy; otherwise return None. If control owns its queue, its copy is the active
        trajectory, because control passes the rest of it to the other nodes.
        """
        active, moment, copy = self.pilot.active, self._moment(), None
        self._injector.strike(moment)
        flown = active.trajectory
        if flown is not None:
            struck = self._injector.strike_latched(flown, moment, active.waypoint)
            if self._injection.in_queue and not self._stack.control_owns_queue:
                copy = None if struck is flown else struck
            else:
                active.exchange(flown, struck)
            self._recovery.judge_changes(self._now_s, flown)
        self._follow(copy)
        return copy

    def _follow(self, copy: Trajectory | None) -> None:
        """Report to the fault's follower that control reads the current waypoint and next yaw.

        Also report which messages are still in use.
        """
        follower, active = self._follower, self.pilot.active
        if not follower.waits:
            return
        flown = copy or active.trajectory
        if flown is not None:
            at = active.waypoint
            follower.read(flown, "control", self._now_s, FOLLOWED_STATES, at)
            follower.read(flown, "control", self._now_s, {"waypoint_yaw"}, at + 1)
        follower.settle(lambda m: m is self.report or m is copy or self.pilot.holds(m))

    def _check_starts(self, inputs: CollisionInputs, start_s: float) -> None:
        self._follower.read(inputs.trajectory, "collision_check", start_s, CHECKED_STATES)

    # Restarts of nodes

    def _octomap_is_up(self) -> None:
        if self._octomap.mates:  # they have lost the map
            self._map = MapSnapshot.empty(self._config.map_resolution_m)

    def _planner_is_up(self) -> None:
        """After a restart of the planner, repeat its lost request unless a newer one is waiting."""
        if not self._stack.restores_counters:
            self._heard_seq = 0
        if self._planner.pending is None:
            self.pilot.plan_lost()

    def _control_is_up(self) -> None:
        """After a restart of control, have the pilot request a new plan if control owns its queue.

        Otherwise control still receives the plan in every tick.
        """
        if self._stack.control_owns_queue and self._state is not None:
            self._queued = None
            self.pilot.control_lost(self._state)

    # Views

    @property
    def _now_s(self) -> float:
        return self.executor.now_s

    def _moment(self, *, foresees: bool = False) -> Moment:
        takeover_s = self._now_s if self._takeover_s is None else self._takeover_s
        return Moment(
            stamp_s=self._now_s,
            flight_s=self._now_s - takeover_s,
            tick=self._ticks,
            phase=self.pilot.mode.value,
            foresees=foresees,
        )

    @property
    def tracked(self) -> tuple[Trajectory, int] | None:
        """The tracked trajectory and the index of its current waypoint, or None without a plan."""
        trajectory = self.pilot.active.trajectory
        if trajectory is None or not len(trajectory.waypoints):
            return None
        return trajectory, self.pilot.active.waypoint
