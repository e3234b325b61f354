"""Laws of trajectories: limits hold for any path, and no bit flip crashes or hangs a consumer."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.autonomy import collision, tracking
from mavfi_cli.autonomy.collision import CollisionParams
from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.autonomy.smoothing import SmoothingParams, smooth
from mavfi_cli.autonomy.tracking import (
    TrackingInputs,
    TrackingParams,
    TrackingState,
    reference_waypoint,
    without_waypoint,
)
from mavfi_cli.core.types import Trajectory

PARAMS = SmoothingParams()
OPEN = ObstacleGrid.build(MapSnapshot.empty(), np.repeat([-math.inf, math.inf], 3), 0.5)

coordinate = st.floats(-40.0, 40.0, allow_nan=False)
points = st.tuples(coordinate, coordinate, st.floats(0.0, 12.0))
paths = st.lists(points, min_size=2, max_size=9).map(np.array)
speeds = st.floats(0.0, 3.0)
angles = st.floats(-math.pi, math.pi)


def departing(velocity, yaw_rad):
    return PlanRequest(
        stamp_s=0.0, position_enu_m=np.zeros(3), velocity_enu_mps=np.array(velocity),
        yaw_rad=yaw_rad, goal_enu_m=np.zeros(3), attempt=1, trajectory_seq=1,
    )  # fmt: skip


@st.composite
def departures(draw):
    speed, azimuth, slope = draw(speeds), draw(angles), draw(st.floats(-0.5, 0.5))
    flat = speed * math.cos(slope)
    velocity = [flat * math.cos(azimuth), flat * math.sin(azimuth), speed * math.sin(slope)]
    return departing(velocity, draw(angles))


def rows_of(trajectory):
    times = np.linspace(0.0, trajectory.duration_s, 12 * len(trajectory.durations_s) + 1)
    return times, np.array([reference_waypoint(trajectory, float(t)) for t in times])


ONE_VERTEX_M = 1e-3  # vertices no farther apart are one (see smoothing)


def assert_flyable(trajectory, start, end, departure, end_atol=1e-9):
    times, rows = rows_of(trajectory)
    waypoints = trajectory.waypoints
    assert (np.linalg.norm(rows[:, 4:7], axis=1) <= PARAMS.v_max_mps + 1e-9).all()
    assert (np.linalg.norm(rows[:, 7:10], axis=1) <= PARAMS.a_max_mps2 + 1e-9).all()
    np.testing.assert_allclose(waypoints[0, :3], start, atol=1e-9)
    np.testing.assert_allclose(waypoints[-1, :3], end, rtol=0.0, atol=end_atol)
    assert not waypoints[-1, 4:].any()
    # Slower than 0.1 m/s counts as at rest.
    np.testing.assert_allclose(waypoints[0, 4:7], departure.velocity_enu_mps, atol=0.1)
    # Continuous in position, velocity and yaw.
    steps_s = np.diff(times)
    assert (
        np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=1)
        <= PARAMS.v_max_mps * steps_s * 1.001 + 1e-9
    ).all()
    assert (
        np.linalg.norm(np.diff(rows[:, 4:7], axis=0), axis=1)
        <= PARAMS.a_max_mps2 * steps_s * 1.001 + 1e-9
    ).all()
    assert (np.abs(np.diff(rows[:, 3])) <= PARAMS.yaw_rate_max_radps * steps_s * 1.001 + 1e-9).all()


@settings(max_examples=150, deadline=None)
@given(paths, departures())
def test_any_path_is_flown_within_the_limits(path, departure):
    made, _ = smooth(path, OPEN, departure, PARAMS)
    last_leg_m = np.linalg.norm(path[-1] - path[-2])
    end_atol = 1e-9 if last_leg_m > ONE_VERTEX_M else ONE_VERTEX_M
    assert_flyable(made, path[0], path[-1], departure, end_atol)


def flown_trajectory():
    path = np.array([[0.0, 0, 5], [10, 0, 5], [14, 9, 6]])
    return smooth(path, OPEN, departing(np.zeros(3), 0.0), PARAMS)[0]


def flip(array, flips):
    """A copy of a float64 array with bits (element, bit) inverted."""
    changed = array.copy()
    words = changed.reshape(-1).view(np.uint64)
    for element, bit in flips:
        words[element % len(words)] ^= np.uint64(1) << np.uint64(bit)
    return changed


flip_lists = st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 63)), min_size=1, max_size=6)
SOUND = flown_trajectory()
WALL = MapSnapshot.of_points(
    np.array([[8.1, y, z] for y in np.arange(-3, 3, 0.2) for z in (4.9, 5.1, 5.3)])
)


def corrupted(in_waypoints, in_durations):
    return Trajectory(
        stamp_s=0.0,
        waypoints=flip(SOUND.waypoints, in_waypoints),
        durations_s=flip(SOUND.durations_s, in_durations),
        trajectory_seq=1,
        future_collision_seq=0,
    )


corrupted_trajectories = st.one_of(
    st.builds(corrupted, flip_lists, flip_lists),
    st.builds(corrupted, flip_lists, st.just([])),
    st.builds(corrupted, st.just([]), flip_lists),
)
times = st.one_of(st.floats(0.0, 10.0), st.floats())


@settings(max_examples=200, deadline=2000)
@given(corrupted_trajectories, times)
def test_the_collision_check_survives_any_flip(trajectory, time_s):
    inputs = collision.CollisionInputs(
        stamp_s=0.0, snapshot=WALL, trajectory=trajectory, time_s=time_s
    )
    _, report = collision.step(collision.CollisionState(), inputs, CollisionParams())
    assert report.time_to_collision_s >= 0.0
    assert report.collision == math.isfinite(report.time_to_collision_s)


@settings(max_examples=200, deadline=2000)
@given(corrupted_trajectories, times, st.floats(), st.floats(0.0, 1.0))
def test_the_tracker_puts_out_something_finite_within_limits(trajectory, time_s, coordinate, rate):
    params = TrackingParams()
    inputs = TrackingInputs(
        stamp_s=0.02,
        position_enu_m=np.array([coordinate, 0.0, 5.0]),
        velocity_enu_mps=np.array([0.0, coordinate, 0.0]),
        trajectory=trajectory,
        time_s=time_s,
        rate=rate,
        hold_enu_m=np.zeros(3),
        hold_yaw_rad=0.0,
    )
    state, command = tracking.step(TrackingState(yaw_rad=0.3, stamp_s=0.0), inputs, params)
    assert np.linalg.norm(command.velocity_enu_mps) <= params.v_max_mps + 1e-9
    assert np.linalg.norm(command.acceleration_enu_mps2) <= params.a_max_mps2 + 1e-9
    assert abs(command.yaw_rad - 0.3) <= params.yaw_rate_max_radps * 0.02 + 1e-9
    assert (np.abs(state.integral_mps) <= params.integral_max_mps).all()


@settings(max_examples=100, deadline=2000)
@given(flip_lists, st.integers(0, len(SOUND.waypoints) - 2))
def test_dropping_a_corrupted_waypoint_undoes_the_corruption(flips, index):
    width = SOUND.waypoints.shape[1]
    within = [(index * width + element % width, bit) for element, bit in flips]
    repaired = without_waypoint(corrupted(within, []), index)
    rows, sound = rows_of(repaired)[1], rows_of(SOUND)[1]
    assert np.isfinite(rows).all()
    # The next waypoint's motion, run back for half a second, differs by its change of acceleration.
    assert np.abs(rows[:, :3] - sound[:, :3]).max() <= 0.5 * 2 * 3.0 * 0.25 + 1e-9
