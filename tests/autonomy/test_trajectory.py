"""What lies between waypoints, checked against the formula written out."""

import math

import numpy as np
import pytest

from mavfi_cli.autonomy.tracking import (
    reference_waypoint,
    waypoint_index,
    without_waypoint,
)
from mavfi_cli.core.types import Trajectory


def made(waypoints, durations_s=None):
    waypoints = np.asarray(waypoints, np.float64)
    if durations_s is None:
        durations_s = np.full(len(waypoints), 0.5)
    return Trajectory(
        stamp_s=0.0,
        waypoints=waypoints,
        durations_s=np.asarray(durations_s, np.float64),
        trajectory_seq=1,
        future_collision_seq=0,
    )


def accelerating():
    """From rest with 2 m/s^2 along x for 1 s, then 1 s back to rest; yaw turns by 1 rad/s."""
    rows = []
    for k, (x, v, a) in enumerate([(0, 0, 2), (0.25, 1, 2), (1, 2, -2), (1.75, 1, -2), (2, 0, 0)]):
        rows.append([x, 5.0, 1.0, 0.5 * k, v, 0, 0, a, 0, 0])
    return made(rows)


@pytest.mark.parametrize("time_s", [0.0, 0.2, 0.5, 0.9, 1.3, 1.99])
def test_even_acceleration_between_waypoints(time_s):
    row = reference_waypoint(accelerating(), time_s)
    up, down = min(time_s, 1.0), max(time_s - 1.0, 0.0)
    assert row[0] == pytest.approx(up**2 + 2 * down - down**2)
    assert row[4] == pytest.approx(2 * up - 2 * down)
    assert row[7] == (2.0 if time_s < 1.0 else -2.0)
    assert row[3] == pytest.approx(time_s)
    assert row[1:3].tolist() == [5.0, 1.0]


def test_before_the_start_the_first_waypoint_and_after_the_end_rest():
    trajectory = made([[0, 0, 5, 0.1, 2, 0, 0, 0, 0, 0]], [1.0])
    assert reference_waypoint(trajectory, -3.0).tolist() == trajectory.waypoints[0].tolist()
    assert reference_waypoint(trajectory, math.nan).tolist() == trajectory.waypoints[0].tolist()
    after = reference_waypoint(trajectory, 7.0)
    assert after.tolist() == [2, 0, 5, 0.1, 0, 0, 0, 0, 0, 0]


def test_yaw_takes_the_short_way_round():
    trajectory = made([[0] * 3 + [3.0] + [0] * 6, [0] * 3 + [-3.0] + [0] * 6])
    middle = reference_waypoint(trajectory, 0.25)[3]
    assert math.cos(middle) == pytest.approx(-1.0)


@pytest.mark.parametrize("bad", [math.nan, -1.0, -math.inf])
def test_senseless_durations_count_as_zero(bad):
    trajectory = made(accelerating().waypoints, [0.5, bad, 0.5, 0.5, 0.5])
    assert waypoint_index(trajectory, 0.4) == 0
    assert waypoint_index(trajectory, 0.6) == 2


def test_an_endless_duration_is_followed_for_ever():
    trajectory = made(accelerating().waypoints, [0.5, math.inf, 0.5, 0.5, 0.5])
    assert waypoint_index(trajectory, 1e6) == 1


def test_no_waypoints_give_no_reference():
    assert np.isnan(reference_waypoint(made(np.empty((0, 10))), 0.0)).all()
    assert waypoint_index(made(np.empty((0, 10))), 0.0) == 0


def test_dropping_a_waypoint_fills_its_time_from_the_next():
    trajectory = accelerating()
    for index in (0, 2):  # 0 has the acceleration of 1, and 2 that of 3: nothing is lost
        broken = trajectory.waypoints.copy()
        broken[index, :3] += 1e6
        repaired = without_waypoint(made(broken), index)
        np.testing.assert_allclose(
            np.delete(repaired.waypoints, 3, axis=1),
            np.delete(trajectory.waypoints, 3, axis=1),
        )


def test_dropping_the_last_waypoint_ends_at_rest_where_the_one_before_leads():
    trajectory = accelerating()
    broken = trajectory.waypoints.copy()
    broken[-1] = math.nan
    repaired = without_waypoint(made(broken), 4)
    np.testing.assert_allclose(repaired.waypoints[-1, :3], [2, 5, 1])
    assert not repaired.waypoints[-1, 4:].any()


def test_the_only_waypoint_stays():
    trajectory = made([[1.0] * 10])
    assert without_waypoint(trajectory, 0) is trajectory


@pytest.mark.parametrize(
    ("start", "end", "turn"), [(0, 1, 1), (3, -3, 2 * math.pi - 6), (-3, 3, 6 - 2 * math.pi)]
)
def test_turns(start, end, turn):
    for begin in (float(start), start + 20 * math.pi):
        trajectory = made([[0.0] * 3 + [yaw] + [0.0] * 6 for yaw in (begin, end)])
        assert reference_waypoint(trajectory, 0.25)[3] - begin == pytest.approx(turn / 2)
