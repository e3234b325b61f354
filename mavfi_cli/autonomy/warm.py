"""Runs every kernel once on a toy scene, so that all are loaded before the first tick."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np

from mavfi_cli.autonomy import OUR_PLANNERS, SMOOTHERS, collision, planners, point_cloud, tracking
from mavfi_cli.autonomy.occupancy import OccupancyMap, OccupancyParams
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.core.compiled import in_cache
from mavfi_cli.core.types import DepthFrame, Trajectory

_BOUNDS = np.array([-5.0, -10.0, 0.0, 15.0, 10.0, 10.0])


def is_compiled() -> bool:
    """Return True if all kernels are compiled. Otherwise `warm_up` takes many seconds."""
    return in_cache(tracking.track)  # the last kernel that `warm_up` calls


@functools.cache  # once for each process and those forked from it
def warm_up() -> None:
    """Run every kernel: observe a wall, map it, plan round it, check the plan and track it."""
    start = np.array([0.0, 0.0, 5.0])
    depth = np.full((48, 64), math.inf)
    depth[:, 20:44] = 4.0
    frame = DepthFrame(
        stamp_s=0.0, depth_m=depth, hfov_rad=math.pi / 2.0, position_enu_m=start,
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    occupancy = OccupancyMap(OccupancyParams())
    occupancy.insert(point_cloud.generate(frame, point_cloud.PointCloudParams()))
    snapshot = occupancy.snapshot()
    request = PlanRequest(
        stamp_s=0.0, position_enu_m=start, velocity_enu_mps=np.array([0.0, 1.0, 0.0]), yaw_rad=0.0,
        goal_enu_m=np.array([9.0, 0.0, 5.0]), attempt=1,
    )  # fmt: skip
    trajectory: Trajectory | None = None
    for name, smoother in itertools.product(OUR_PLANNERS, SMOOTHERS[::-1]):
        result = planners.plan(
            planners.find(name), request, snapshot,
            bounds_enu_m=_BOUNDS, seed=1, params=planners.PlanningParams(smoother=smoother),
        )  # fmt: skip
        trajectory = result if isinstance(result, Trajectory) else None
    checked = collision.CollisionInputs(
        stamp_s=0.0, snapshot=snapshot, trajectory=trajectory, time_s=0.0
    )
    collision.step(collision.CollisionState(), checked, collision.CollisionParams())
    if trajectory is not None:
        tracking.reference_waypoint(trajectory, 0.0)
    tracked = tracking.TrackingInputs(
        stamp_s=0.02, position_enu_m=np.zeros(3), velocity_enu_mps=np.zeros(3),
        trajectory=trajectory, hold_enu_m=np.zeros(3), hold_yaw_rad=0.0,
    )  # fmt: skip
    state = tracking.TrackingState(yaw_rad=0.0, stamp_s=0.0)
    tracking.step(state, tracked, tracking.TrackingParams(stretches_clock=True))
