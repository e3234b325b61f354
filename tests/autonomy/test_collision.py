"""The collision check against closed forms and against exact distances."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mavfi_cli.autonomy import collision
from mavfi_cli.autonomy.collision import (
    CollisionInputs,
    CollisionParams,
    CollisionState,
)
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.core.types import Trajectory

PARAMS = CollisionParams()
FREE = MapSnapshot.empty()


def straight(speed_mps=3.0, count=30, y=0.1, seq=1):
    waypoints = np.zeros((count, 10))
    waypoints[:, 0] = np.arange(count) * 0.5 * speed_mps
    waypoints[:, 1], waypoints[:, 2], waypoints[:, 4] = y, 5.1, speed_mps
    return Trajectory(
        stamp_s=0.0,
        waypoints=waypoints,
        durations_s=np.full(count, 0.5),
        trajectory_seq=seq,
        future_collision_seq=0,
    )


def wall(x=20.1, half_width=3.0):
    across = np.arange(-half_width, half_width, 0.2) + 0.1
    y, z = np.meshgrid(across, across + 5.0)
    return MapSnapshot.of_points(np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1))


def time_to_collision(snapshot, trajectory, time_s, params):
    return collision.step(CollisionState(), inputs(snapshot, trajectory, time_s), params)[
        1
    ].time_to_collision_s


def inputs(snapshot, trajectory, time_s=0.0):
    return CollisionInputs(stamp_s=12.0, snapshot=snapshot, trajectory=trajectory, time_s=time_s)


@pytest.mark.parametrize("time_s", [0.0, 1.3, 4.0])
@pytest.mark.parametrize("radius_m", [0.5, 0.9])
def test_time_to_a_wall_ahead(time_s, radius_m):
    params = replace(PARAMS, radius_m=radius_m)
    found = time_to_collision(wall(), straight(), time_s, params)
    contact_s = (20.0 - radius_m) / 3.0 - time_s
    # No later than contact, and no earlier than two steps of 0.2 m.
    assert contact_s - 0.14 < found <= contact_s + 1e-9


def test_what_lies_behind_does_not_matter():
    assert time_to_collision(wall(x=2.1), straight(), 2.0, PARAMS) == math.inf


@pytest.mark.parametrize(("offset_m", "hit"), [(0.85, True), (0.97, False), (-0.85, True)])
def test_the_radius_decides_beside_an_obstacle(offset_m, hit):
    # One voxel, [10, 10.2] x [0, 0.2] x [5, 5.2]; the path passes its face at `offset_m`.
    y = 0.2 + offset_m if offset_m > 0 else offset_m
    voxel = MapSnapshot.of_points(np.array([[10.1, 0.1, 5.1]]))
    assert math.isfinite(time_to_collision(voxel, straight(y=y), 0.0, PARAMS)) is hit


def test_no_thin_obstacle_is_jumped_over():
    rng = np.random.default_rng(0)
    for _ in range(50):
        x = rng.uniform(2.0, 40.0)
        side = rng.uniform(-0.85, 0.85)
        voxel = MapSnapshot.of_points(np.array([[x, 0.1 + side, 5.1]]))
        speed = rng.uniform(0.5, 9.0)
        trajectory = straight(speed, count=math.ceil(42.0 / speed / 0.5))
        assert math.isfinite(time_to_collision(voxel, trajectory, 0.0, PARAMS))


def test_acceleration_bends_the_path_that_is_checked():
    trajectory = straight(count=4)
    trajectory.waypoints[1, 8] = 16.0  # 2 m sideways within its half second
    beside = MapSnapshot.of_points(np.array([[2.9, 2.1, 5.1]]))
    assert math.isfinite(time_to_collision(beside, trajectory, 0.0, PARAMS))
    assert time_to_collision(beside, straight(count=4), 0.0, PARAMS) == math.inf


def test_a_jump_between_waypoints_is_checked_too():
    trajectory = straight(speed_mps=0.0, count=2)
    trajectory.waypoints[1, 0] = 30.0
    assert math.isfinite(time_to_collision(wall(), trajectory, 0.0, PARAMS))


def test_a_vehicle_in_contact_may_leave_but_not_go_on():
    close = wall(x=0.7)  # 0.6 m ahead of the start: inside the radius, outside the body
    away = straight()
    away.waypoints[:, 0] *= -1.0
    away.waypoints[:, 4] *= -1.0
    assert time_to_collision(close, away, 0.0, PARAMS) == math.inf
    assert math.isfinite(time_to_collision(close, straight(), 0.0, PARAMS))
    assert math.isfinite(time_to_collision(close, straight(speed_mps=0.05), 0.0, PARAMS))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300, -1e300])
@pytest.mark.parametrize("column", [0, 1, 2, 4, 5, 6, 7, 8, 9])
def test_an_unflyable_waypoint_is_a_collision_at_its_time(bad, column):
    trajectory = straight()
    trajectory.waypoints[6, column] = bad
    found = time_to_collision(FREE, trajectory, 1.0, PARAMS)
    assert 2.0 <= found <= 2.5


def test_the_report_counts_a_collision_once_for_each_trajectory():
    state = CollisionState(future_collision_seq=4)
    state, report = collision.step(state, inputs(FREE, straight()), PARAMS)
    assert (report.collision, report.future_collision_seq) == (False, 4)
    assert report.time_to_collision_s == math.inf
    for _ in range(3):
        state, report = collision.step(state, inputs(wall(), straight()), PARAMS)
        assert (report.collision, report.future_collision_seq) == (True, 5)
    state, report = collision.step(state, inputs(wall(), straight(seq=2)), PARAMS)
    assert report.future_collision_seq == 6
    state, report = collision.step(state, inputs(FREE, straight(seq=2)), PARAMS)
    state, report = collision.step(state, inputs(wall(), straight(seq=2)), PARAMS)
    assert report.future_collision_seq == 7
    assert report.stamp_s == 12.0


def test_nothing_to_check_is_free():
    _, report = collision.step(CollisionState(), inputs(wall(), None), PARAMS)
    assert not report.collision
    empty = replace(straight(), waypoints=np.empty((0, 10)), durations_s=np.empty(0))
    assert time_to_collision(wall(), empty, 0.0, PARAMS) == math.inf


def test_the_counter_stays_an_int32():
    state = CollisionState(future_collision_seq=0x7FFF_FFFF)
    _, report = collision.step(state, inputs(wall(), straight()), PARAMS)
    assert report.future_collision_seq == 0
