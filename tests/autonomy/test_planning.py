"""The whole planning stage: from a map to a trajectory that the collision check finds free."""

import math
from dataclasses import replace

import numpy as np

from mavfi_cli.autonomy import collision, planners, warm
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.core.types import Trajectory

BOUNDS = np.array([-5.0, -12.0, 1.0, 25.0, 12.0, 10.0])


def blocks():
    rng = np.random.default_rng(4)
    cells = np.arange(0.1, 2.0, 0.2)
    block = np.stack(np.meshgrid(cells, cells, np.arange(0.1, 9, 0.2)), axis=-1).reshape(-1, 3)
    corners = [(5, -1), (9, 3), (9, -6), (14, -1), (14, 7)]
    shifts = [np.array([x, y + rng.uniform(-0.5, 0.5), 0.0]) for x, y in corners]
    return MapSnapshot.of_points(np.vstack([block + shift for shift in shifts]))


def request(velocity=(0.0, 0.0, 0.0), goal=(20.0, 0.0, 5.0)):
    return PlanRequest(
        stamp_s=3.0,
        position_enu_m=np.array([0.0, 0.0, 5.0]),
        velocity_enu_mps=np.array(velocity),
        yaw_rad=0.0,
        goal_enu_m=np.array(goal),
        attempt=1,
        trajectory_seq=5,
        future_collision_seq=2,
    )


def plan(planner, asked, seed=1, snapshot=None, bounds=BOUNDS):
    params, snapshot = planners.PlanningParams(), snapshot or blocks()
    return planners.plan(
        planners.find(planner), asked, snapshot, bounds_enu_m=bounds, seed=seed, params=params
    )


def test_plans_pass_the_collision_check_at_rest_and_in_motion():
    rng = np.random.default_rng(0)
    for seed in range(12):
        velocity = rng.uniform(-1, 1, 3) * [1.5, 1.5, 0.2] if seed % 2 else np.zeros(3)
        found = plan("rrtstar", request(velocity), seed)
        assert isinstance(found, Trajectory), found.reason
        inputs = collision.CollisionInputs(
            stamp_s=0.0, snapshot=blocks(), trajectory=found, time_s=0.0
        )
        _, checked = collision.step(collision.CollisionState(), inputs, collision.CollisionParams())
        assert checked.time_to_collision_s == math.inf
        assert found.trajectory_seq == 5
        assert np.ptp(found.waypoints[:, 1:3]) > 0.5  # it goes round the blocks


def test_a_map_whose_obstacles_lie_too_far_apart_gives_no_plan():
    """As one that was seen from a position that is not the vehicle's."""
    ends = MapSnapshot.of_points(np.array([[-900.0, -900.0, 0.0], [900.0, 900.0, 10.0]]))
    huge = np.array([-1e3, -1e3, -10.0, 1e3, 1e3, 20.0])
    refused = plan("rrtstar", request(), snapshot=ends, bounds=huge)
    assert "too far apart" in refused.reason


def test_a_blocked_goal_is_refused_with_its_reason():
    found = plan("rrt", request(goal=(6.0, 0.0, 5.0)))
    assert (found.stamp_s, found.reason) == (3.0, "goal blocked")


def test_a_start_that_cannot_stop_in_time_is_refused():
    given = request(velocity=(3.0, 0.0, 0.0))
    found = plan("rrtstar", replace(given, position_enu_m=np.array([2.9, 0.0, 5.0])))
    assert (found.stamp_s, found.reason) == (3.0, "no free way on")


def test_warm_up_runs_every_kernel():
    warm.warm_up()
