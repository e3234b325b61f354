"""Shortcutting keeps the ends, never lengthens, and never leaves free space."""

from types import SimpleNamespace

import numpy as np
import pytest

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.autonomy.planners import PlanningParams, PlanResult, plan
from mavfi_cli.autonomy.tracking import reference_waypoint

BOUNDS = np.array([-10.0, -10.0, 0.0, 10.0, 10.0, 10.0])
PARAMS = PlanningParams(radius_m=0.5)


def flown(path, snapshot):
    """Positions every 20 ms on the plan that the stage makes of a planner's path."""
    path = np.array(path, np.float64)
    request = PlanRequest(
        stamp_s=0.0, position_enu_m=path[0], velocity_enu_mps=np.zeros(3), yaw_rad=0.0,
        goal_enu_m=path[-1], attempt=1,
    )  # fmt: skip
    planner = SimpleNamespace(plan=lambda _problem, _seed: PlanResult(found=True, path_enu_m=path))
    made = plan(planner, request, snapshot, bounds_enu_m=BOUNDS, seed=1, params=PARAMS)
    times_s = np.arange(0.0, made.duration_s, 0.02)
    return np.array([reference_waypoint(made, time_s)[:3] for time_s in times_s])


def length(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum()


def test_random_walks_become_shorter_and_stay_free():
    rng = np.random.default_rng(0)
    snapshot = MapSnapshot.of_points(rng.uniform([-9, -9, 3], [9, 9, 7], (30, 3)))
    grid = ObstacleGrid.build(snapshot, BOUNDS, PARAMS.radius_m)
    for _ in range(12):
        path = [np.array([-9.5, -9.5, 5.0])]
        while len(path) < 12:
            candidate = np.clip(path[-1] + rng.normal(size=3) * 2, BOUNDS[:3], BOUNDS[3:])
            if grid.segment_free(path[-1], candidate):
                path.append(candidate)
        short = flown(path, snapshot)
        assert grid.path_free(short)
        assert length(short) <= length(path) + 1e-9
        np.testing.assert_allclose(short[[0, -1]], np.array(path)[[0, -1]], atol=1e-6)


def test_in_free_sight_the_way_is_straight():
    rows = flown([[0, 0, 5], [1, 1, 5], [2, -1, 5], [3, 0, 5]], MapSnapshot.empty())
    assert np.abs(rows[:, 1]).max() == 0.0
    assert length(rows) == pytest.approx(3.0)


def test_a_way_round_a_corner_leaves_its_long_legs():
    pole = MapSnapshot.of_points(np.array([[0.1, 0.1, z + 0.1] for z in np.arange(0, 10, 0.2)]))
    legs = [[-8, -1, 5], [8, -1, 5], [8, 8, 5]]
    rows = flown(legs, pole)
    # The legs' ends do not see each other, but points on the legs do.
    assert length(rows) < length(np.array(legs, float)) - 3.0
