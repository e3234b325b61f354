"""Smoothing: where it starts and ends, what it keeps to, and how it deals with corridors."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.autonomy.smoothing import (
    SmoothingParams,
    smooth,
)
from mavfi_cli.autonomy.tracking import reference_waypoint

PARAMS = SmoothingParams()
BOUNDS = np.array([-20.0, -20.0, 0.0, 20.0, 20.0, 10.0])
OPEN = ObstacleGrid.build(MapSnapshot.empty(), BOUNDS, 0.5)


def departure(velocity=(0.0, 0.0, 0.0), yaw_rad=0.0):
    return PlanRequest(
        stamp_s=7.0, position_enu_m=np.zeros(3), velocity_enu_mps=np.array(velocity, float),
        yaw_rad=yaw_rad, goal_enu_m=np.zeros(3), attempt=1,
    )  # fmt: skip


def smoothed(*arguments):
    trajectory, free = smooth(*arguments)
    return SimpleNamespace(trajectory=trajectory, free=free)


def flown(trajectory, step_s=0.02):
    times = np.arange(0.0, trajectory.duration_s, step_s)
    return np.array([reference_waypoint(trajectory, t) for t in times])


def path(*points):
    return np.array(points, np.float64)


def test_a_straight_flight_takes_as_long_as_a_trapezoid():
    result = smoothed(path([0, 0, 5], [15, 0, 5]), OPEN, departure(), PARAMS)
    speed, acceleration = 2.7, 3.0
    ideal_s = 15.0 / speed + speed / acceleration
    assert ideal_s <= result.trajectory.duration_s <= ideal_s + 3 * PARAMS.sample_period_s
    rows = flown(result.trajectory)
    assert rows[:, 4].max() == pytest.approx(speed)
    assert np.abs(rows[:, [1, 5, 8]]).max() == 0.0
    assert result.free


def test_sequence_and_stamp_are_carried():
    numbered = replace(departure(), trajectory_seq=4, future_collision_seq=2)
    made = smoothed(path([0, 0, 5], [5, 0, 5]), OPEN, numbered, PARAMS).trajectory
    assert (made.stamp_s, made.trajectory_seq, made.future_collision_seq) == (7.0, 4, 2)
    assert (made.durations_s == 0.5).all()


def test_vertical_speeds_keep_their_own_limits():
    up = smoothed(path([0, 0, 1], [0, 0, 9]), OPEN, departure(), PARAMS).trajectory
    down = smoothed(path([0, 0, 9], [0, 0, 1]), OPEN, departure(), PARAMS).trajectory
    assert flown(up)[:, 6].max() == pytest.approx(PARAMS.climb_max_mps)
    assert flown(down)[:, 6].min() == pytest.approx(-PARAMS.descent_max_mps)


def test_a_corner_is_cut_no_more_than_allowed():
    corner = path([0, 0, 5], [10, 0, 5], [10, 10, 5])
    rows = flown(smoothed(corner, OPEN, departure(), PARAMS).trajectory)
    gap = np.linalg.norm(rows[:, :3] - corner[1], axis=1).min()
    # The spline adds at most a T^2 / 8.
    assert 0.2 < gap <= PARAMS.corner_cut_m + 3.0 * 0.25 / 8.0
    assert np.linalg.norm(rows[:, 4:7], axis=1)[100:-100].min() > 1.0


def test_where_a_corner_may_not_be_cut_it_is_slowed_down_until_it_is_free():
    # A wall inside the corner, so close that only the legs themselves are free.
    legs = path([-8, 0, 5], [0, 0, 5], [0, 8, 5])
    cells = np.array([[-0.85 - 0.2 * i, 0.85 + 0.2 * j, 5.1] for i in range(20) for j in range(20)])
    grid = ObstacleGrid.build(MapSnapshot.of_points(cells), BOUNDS, 0.5)
    assert grid.path_free(legs)
    fast = smoothed(legs, OPEN, departure(), PARAMS)
    assert not grid.path_free(flown(fast.trajectory)[:, :3])
    careful = smoothed(legs, grid, departure(), PARAMS)
    assert careful.free
    assert grid.path_free(flown(careful.trajectory)[:, :3])
    np.testing.assert_allclose(careful.trajectory.waypoints[-1, :3], legs[-1])


@pytest.mark.parametrize("yaw_rad", [math.pi, -math.pi / 2, 2.0])
def test_a_large_turn_is_made_before_flying_so_that_the_camera_looks_ahead(yaw_rad):
    made = smoothed(path([0, 0, 5], [10, 0, 5]), OPEN, departure(yaw_rad=yaw_rad), PARAMS)
    rows = flown(made.trajectory)
    moving = np.linalg.norm(rows[:, 4:7], axis=1) > 0.5
    assert np.abs(np.cos(rows[moving, 3]) - 1.0).max() < 0.3
    assert rows[0, 3] == yaw_rad


def test_a_small_turn_is_made_on_the_way():
    made = smoothed(path([0, 0, 5], [10, 0, 5]), OPEN, departure(yaw_rad=0.7), PARAMS)
    straight = smoothed(path([0, 0, 5], [10, 0, 5]), OPEN, departure(), PARAMS)
    assert made.trajectory.duration_s == straight.trajectory.duration_s
    assert made.trajectory.waypoints[-1, 3] == pytest.approx(0.0, abs=1e-9)


def test_a_start_in_motion_goes_on_smoothly():
    velocity = np.array([0.0, 2.5, 0.0])
    made = smoothed(path([0, 0, 5], [12, 0, 5]), OPEN, departure(velocity, 1.5), PARAMS)
    first = reference_waypoint(made.trajectory, 0.0)
    np.testing.assert_allclose(first[:3], [0, 0, 5], atol=1e-12)
    np.testing.assert_allclose(first[4:7], velocity, atol=1e-12)
    assert made.free


def test_a_start_in_motion_towards_a_wall_is_not_called_free():
    wall = MapSnapshot.of_points(np.array([[0.1, 1.1 + 0.0, 5.1]]))
    grid = ObstacleGrid.build(wall, BOUNDS, 0.5)
    made = smoothed(path([0, 0, 5], [12, 0, 5]), grid, departure((0, 2.5, 0), 1.5), PARAMS)
    assert not made.free
    assert np.isfinite(made.trajectory.waypoints).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_a_senseless_departure_gives_a_sound_trajectory(bad):
    made = smoothed(path([0, 0, 5], [5, 0, 5]), OPEN, departure((bad, 0, 0), bad), PARAMS)
    assert np.isfinite(made.trajectory.waypoints).all()
    assert (np.linalg.norm(flown(made.trajectory)[:, 4:7], axis=1) <= 3.0 + 1e-9).all()


def test_a_path_that_is_a_point_is_a_hover():
    here = path([1, 2, 5], [1, 2, 5])
    made = smoothed(here, OPEN, departure(), PARAMS)
    assert (made.trajectory.waypoints[:, :3] == here[0]).all()


def test_other_limits_are_kept_as_well():
    slow = replace(PARAMS, v_max_mps=1.0, a_max_mps2=0.5)
    corner = path([0, 0, 5], [4, 0, 5], [4, 4, 5])
    rows = flown(smoothed(corner, OPEN, departure(), slow).trajectory)
    assert np.linalg.norm(rows[:, 4:7], axis=1).max() <= 1.0
    assert np.linalg.norm(rows[:, 7:10], axis=1).max() <= 0.5
