"""Minimum-snap smoothing: against SciPy's spline, and what it does where the way is narrow."""

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.autonomy.smoothing import SmoothingParams, smooth_as_released

PARAMS = SmoothingParams()
BOUNDS = np.array([-60.0, -60.0, 0.0, 60.0, 60.0, 10.0])
OPEN = ObstacleGrid.build(MapSnapshot.empty(), BOUNDS, 0.5)
ZERO = np.zeros(3)


def smoothed(path, grid=OPEN, velocity=(0.0, 0.0, 0.0)):
    request = PlanRequest(
        stamp_s=7.0, position_enu_m=ZERO, velocity_enu_mps=np.array(velocity, float), yaw_rad=0.0,
        goal_enu_m=ZERO, attempt=1, trajectory_seq=4, future_collision_seq=2,
    )  # fmt: skip
    return smooth_as_released(np.array(path, np.float64), grid, request, PARAMS)


def duration_s(length_m):
    """Segment time of the release for v_max 3 m/s and a_max 5 m/s^2."""
    direct_s = 2.0 * length_m / 3.0
    return direct_s * (1.0 + 6.5 * 0.6 * np.exp(-direct_s))


def walled(low, high):
    """A grid in which the voxels (1 m) from `low` to below `high` are blocked."""
    blocked = np.zeros((120, 120, 10), np.uint8)
    blocked[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = 1
    return ObstacleGrid(
        blocked=blocked, origin_enu_m=BOUNDS[:3], resolution_m=1.0, bounds_enu_m=BOUNDS
    )


def test_a_straight_flight_takes_the_times_of_the_release_and_is_a_cubic():
    trajectory, free = smoothed([[0, 0, 5], [50, 0, 5]])
    assert free
    assert trajectory.duration_s == 33.0  # 33.3 s in whole samples
    u = np.arange(66) * 0.5 / duration_s(50.0)
    assert trajectory.waypoints[:, 0] == pytest.approx(50.0 * (3 * u**2 - 2 * u**3), abs=1e-9)
    assert trajectory.waypoints[:, 4].max() == pytest.approx(1.5 * 50.0 / 33.33, rel=1e-3)
    assert (trajectory.stamp_s, trajectory.trajectory_seq) == (7.0, 4)
    assert trajectory.future_collision_seq == 2


@pytest.mark.parametrize("vertices", [3, 6, 20])
def test_it_is_the_spline_of_degree_seven_that_scipy_finds(vertices):
    path = np.cumsum(np.random.default_rng(vertices).uniform(-3, 4, (vertices, 3)), axis=0)
    path[:, 2] = 5.0
    velocity = np.array([1.0, -0.5, 0.0])
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    knots = np.concatenate([[0.0], np.cumsum(duration_s(lengths))])
    free_ends = [(4, ZERO), (5, ZERO)]
    ends = ([(1, velocity), *free_ends], [(1, ZERO), *free_ends])
    spline = make_interp_spline(knots, path, k=7, bc_type=ends)
    wide = np.array([-1e3, -1e3, -1e3, 1e3, 1e3, 1e3])
    grid = ObstacleGrid.build(MapSnapshot.empty(), wide, 0.5)
    trajectory, free = smoothed(path, grid, velocity)
    assert free
    times_s = np.arange(len(trajectory.waypoints)) * 0.5
    for order, columns in enumerate((slice(0, 3), slice(4, 7), slice(7, 10))):
        expected = spline(times_s, nu=order)
        assert np.abs(trajectory.waypoints[:, columns] - expected).max() < 1e-9


def test_a_segment_that_is_not_free_gets_more_vertices():
    corner = [[0, 0, 5], [20, 0, 5], [20, 20, 5]]
    # The spline swings outwards at the corner. The wall is 1 m from the straight legs.
    wall = walled((81, 40, 0), (83, 100, 10))
    easy, _ = smoothed(corner)
    hard, free = smoothed(corner, wall)
    assert free
    assert easy.waypoints[:, 0].max() > 22.0 > 21.0 > hard.waypoints[:, 0].max()
    assert wall.path_free(hard.waypoints[:, :3])


def test_a_path_that_cannot_be_flown_freely_is_said_to_be_blocked():
    _, free = smoothed([[0, 0, 5], [20, 0, 5]], walled((70, 55, 0), (72, 65, 10)))
    assert not free


@pytest.mark.parametrize("velocity", [(np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0), (1e300, 0.0, 0.0)])
def test_a_corrupted_velocity_gives_a_finite_trajectory(velocity):
    trajectory, _ = smoothed([[0, 0, 5], [0, 0, 5.02], [10, 0, 5]], velocity=velocity)
    assert np.isfinite(trajectory.waypoints).all()


def test_a_path_of_no_length_is_one_waypoint():
    trajectory, free = smoothed([[1, 1, 5], [1, 1, 5]])
    assert free
    assert trajectory.waypoints[:, :3] == pytest.approx(np.array([[1.0, 1.0, 5.0]]))
