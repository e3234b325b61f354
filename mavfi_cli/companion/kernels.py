"""The kernels of the mission's nodes, with the state that they keep between invocations.

If a node runs in its own process, its state lives there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mavfi_cli.autonomy import collision, occupancy, planners, point_cloud, smoothing, tracking
from mavfi_cli.autonomy.pilot import PlanFailure, PlanRequest
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import (
    Briefing,
    CollisionReport,
    Command,
    DepthFrame,
    PointCloud,
    Trajectory,
)
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.stack import Stack


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlInput:
    """Input of the kernel `control`.

    Attributes:
        goes_on: True if control continues with its own copy of the plan, not the one in `inputs`.
    """

    inputs: tracking.TrackingInputs
    goes_on: bool = False
    fresh: tracking.TrackingState | None  # state to start from; None: the controller's own
    yaw_rad: float  # vehicle's yaw, for the first invocation of the controller


class Kernels:
    """The kernels of all nodes: methods that map an input and its start stamp to an output."""

    def __init__(
        self, config: MissionConfig, stack: Stack, planner: planners.Planner, briefing: Briefing
    ) -> None:
        self._stack = stack
        self._seed = config.seed
        self._planner = planner
        v_max, a_max = config.v_max_mps, config.a_max_mps2
        self._cloud_params = point_cloud.PointCloudParams(max_range_m=config.map_range_m)
        self._map = occupancy.OccupancyMap(
            occupancy.OccupancyParams(
                resolution_m=config.map_resolution_m, max_range_m=config.map_range_m
            )
        )
        self._collision_params = collision.CollisionParams(
            radius_m=stack.check_radius_m,
            farthest_m=stack.farthest_waypoint_m,
            **stack.settings_of(collision.CollisionParams),
        )
        self._collision_state = collision.CollisionState()
        self._planning_params = planners.PlanningParams(
            radius_m=stack.planner_radius_m,
            smoothing=smoothing.SmoothingParams(v_max_mps=v_max, a_max_mps2=a_max),
            **stack.settings_of(planners.PlanningParams),
        )
        self._bounds_enu_m = briefing.bounds_enu_m
        self._tracking_params = tracking.TrackingParams(
            kp_per_s=stack.position_gain_per_s,
            kp_climb_per_s=stack.climb_gain_per_s,
            ki_per_s2=stack.integral_gain_per_s2,
            kd=stack.damping_gain,
            v_max_mps=v_max,
            a_max_mps2=a_max,
            **stack.settings_of(tracking.TrackingParams),
        )
        self._tracking_state: tracking.TrackingState | None = None
        self._queue: Trajectory | None = None  # control's own copy of the plan
        self._plans = 0  # plans counted by the planner

    def point_cloud(self, frame: DepthFrame, _stamp_s: float) -> PointCloud:
        """Convert a depth frame to a point cloud in world coordinates."""
        return point_cloud.generate(frame, self._cloud_params)

    def octomap(self, cloud: PointCloud, _stamp_s: float) -> occupancy.MapSnapshot:
        """Integrate a point cloud into the occupancy map, and return a snapshot of the map."""
        self._map.insert(cloud)
        return self._map.snapshot()

    def collision_check(self, inputs: collision.CollisionInputs, stamp_s: float) -> CollisionReport:
        """Check a trajectory for collisions with the occupancy map."""
        read = replace(inputs, stamp_s=stamp_s, trajectory=self._as_read(inputs.trajectory))
        self._collision_state, report = collision.step(
            self._collision_state, read, self._collision_params
        )
        return report

    def planner(
        self, job: tuple[PlanRequest, occupancy.MapSnapshot], _stamp_s: float
    ) -> Trajectory | PlanFailure:
        """Plan a trajectory for a request. If planning fails, return the reason."""
        request, snapshot = job
        newest = request.trajectory_seq
        if self._stack.owns_sequence_numbers:
            newest, self._plans = self._plans, self._plans + 1
        return planners.plan(
            self._planner,
            replace(request, trajectory_seq=_next_int32(newest)),
            snapshot,
            bounds_enu_m=self._bounds_enu_m,
            seed=Stream.PLANNER.seed(self._seed, request.attempt),
            params=self._planning_params,
        )

    def control(self, job: ControlInput, _stamp_s: float) -> Command:
        """Run the controller for one tick, and return its command."""
        state = job.fresh or self._tracking_state
        if state is None:
            state = tracking.TrackingState(yaw_rad=job.yaw_rad, stamp_s=job.inputs.stamp_s)
        inputs = job.inputs
        if job.goes_on:
            inputs = replace(inputs, trajectory=self._queue)
        elif inputs.trajectory is not None:
            inputs = replace(inputs, trajectory=self._as_read(inputs.trajectory))
        self._queue = inputs.trajectory
        self._tracking_state, command = tracking.step(state, inputs, self._tracking_params)
        return command

    def restore_check(self, report: CollisionReport | None) -> None:
        """Restore the sequence number of the last report before the collision check restarts."""
        if report is not None:
            self._collision_state = collision.CollisionState(
                future_collision_seq=report.future_collision_seq
            )

    def restore_planner(self, plans: Sequence[Trajectory]) -> None:
        """Restore the sequence number of the last plan before the planner restarts."""
        if plans:
            self._plans = plans[-1].trajectory_seq

    def _as_read(self, trajectory: Trajectory | None) -> Trajectory | None:
        """Return a trajectory as readers use it: without accelerations if feed-forward is off."""
        if trajectory is None or self._stack.feeds_acceleration_forward:
            return trajectory
        waypoints = trajectory.waypoints.copy()
        waypoints[:, 7:10] = 0.0
        return replace(trajectory, waypoints=waypoints)


def _next_int32(value: int) -> int:
    """Return `value` + 1, wrapped to a signed 32-bit integer. A fault may make it overflow."""
    return (value + 1 + 2**31) % 2**32 - 2**31
