"""What every planner must do, whoever wrote it."""

import itertools
import subprocess
import sys

import fcl
import numpy as np
import pytest

from mavfi_cli.autonomy import planners
from mavfi_cli.autonomy.occupancy import empty_snapshot, snapshot_of
from mavfi_cli.autonomy.planners import PlanningParams, pose_problem, registry
from mavfi_cli.core.errors import UnknownName

RESOLUTION_M = 0.2
PARAMS = PlanningParams()
BOUNDS = np.array([-5.0, -12.0, 1.0, 25.0, 12.0, 10.0])
START, GOAL = np.array([0.0, 0.0, 5.0]), np.array([20.0, 0.0, 5.0])

every_planner = pytest.mark.parametrize("name", planners.names())


def slab(low, high):
    """Points that fill the voxels of a box."""
    axes = [
        np.arange(a, b, RESOLUTION_M) + 0.5 * RESOLUTION_M for a, b in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def wall_with_gap(gap_m=4.0):
    """A wall across all of the bounds but for a gap at y = 6."""
    below = slab((10, -13, 0), (10.4, 6 - gap_m / 2, 11))
    above = slab((10, 6 + gap_m / 2, 0), (10.4, 13, 11))
    return snapshot_of(np.vstack([below, above]))


def closed_box(around, half=3.0):
    """Six walls round a point."""
    faces = []
    for axis in range(3):
        for side in (-half, half):
            low, high = around - half, around + half + RESOLUTION_M
            low[axis] = around[axis] + side
            high[axis] = low[axis] + RESOLUTION_M
            faces.append(slab(low, high))
    return snapshot_of(np.vstack(faces))


def posed(snapshot, start=START, goal=GOAL, params=PARAMS):
    return pose_problem(snapshot, start, goal, BOUNDS, params)


def clearance(path, snapshot):
    """Exact distance between a path and the map, by FCL."""
    tree = fcl.CollisionObject(fcl.OcTree(snapshot.resolution_m, snapshot.signed_bytes()))
    smallest = np.inf
    for start, end in itertools.pairwise(path):
        steps = max(2, int(np.linalg.norm(end - start) / 0.05))
        for share in np.linspace(0, 1, steps):
            point = fcl.Transform(start + share * (end - start))
            probe = fcl.CollisionObject(fcl.Sphere(1e-3), point)
            found = fcl.distance(probe, tree, fcl.DistanceRequest(), fcl.DistanceResult())
            smallest = min(smallest, found + 1e-3)
    return smallest


@every_planner
def test_finds_the_gap_and_keeps_its_distance(name):
    snapshot = wall_with_gap()
    for seed in range(3):
        result = planners.find(name).plan(posed(snapshot), seed)
        assert result.found, result.reason
        np.testing.assert_array_equal(result.path_enu_m[0], START)
        np.testing.assert_array_equal(result.path_enu_m[-1], GOAL)
        assert (result.path_enu_m >= BOUNDS[:3]).all()
        assert (result.path_enu_m <= BOUNDS[3:]).all()
        assert clearance(result.path_enu_m, snapshot) >= PARAMS.radius_m - 1e-6


@every_planner
def test_is_a_function_of_problem_and_seed(name):
    problem = posed(wall_with_gap())
    planner = planners.find(name)
    first = planner.plan(problem, 7).path_enu_m
    for other in planners.names():
        planners.find(other).plan(posed(wall_with_gap(5.0)), 3)
    assert np.array_equal(planner.plan(problem, 7).path_enu_m, first)
    assert not np.array_equal(planner.plan(problem, 8).path_enu_m, first)


@every_planner
def test_repeats_in_another_process(name):
    code = (
        "from tests.contract.test_planners import *\n"
        f"result = planners.find({name!r}).plan(posed(wall_with_gap()), 7)\n"
        "print(result.path_enu_m.tobytes().hex())"
    )
    other = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    here = planners.find(name).plan(posed(wall_with_gap()), 7)
    assert other.stdout.strip() == here.path_enu_m.tobytes().hex()


@every_planner
def test_a_closed_box_is_an_honest_failure(name):
    result = planners.find(name).plan(posed(closed_box(START)), 1)
    assert not result.found
    assert len(result.path_enu_m) == 0
    assert result.reason
    # Nearest it can come to the goal is the inside of the box.
    assert 17.0 < result.nearest_m <= 20.0


@every_planner
def test_free_sight_is_flown_straight(name):
    result = planners.find(name).plan(posed(empty_snapshot()), 1)
    assert result.found
    assert result.length_m == pytest.approx(20.0, rel=0.01)


@every_planner
@pytest.mark.parametrize(
    ("start", "goal", "reason"),
    [
        ((0, 0, 5), (10.2, 0, 5), "goal blocked"),
        ((0, 0, 5), (99, 0, 5), "goal blocked"),
        ((0, 0, 5), (np.nan, 0, 5), "goal blocked"),
        ((10.2, 0, 5), (20, 0, 5), "start blocked"),
        ((np.nan, 0, 5), (20, 0, 5), "start blocked"),
        ((0, 0, 5), (1e300, 0, 5), "goal blocked"),
    ],
)
def test_impossible_ends_are_reported(name, start, goal, reason):
    problem = posed(wall_with_gap(), np.array(start, float), np.array(goal, float))
    result = planners.find(name).plan(problem, 1)
    assert (result.found, result.reason) == (False, reason)


@every_planner
def test_a_start_too_close_to_a_wall_can_leave(name):
    start = np.array([9.5, 0.0, 5.0])  # half a metre from the wall, less than the radius
    result = planners.find(name).plan(posed(wall_with_gap(), start), 2)
    assert result.found, result.reason
    far = np.linalg.norm(result.path_enu_m - start, axis=1) > PARAMS.escape_radius_m + 0.2
    assert clearance(result.path_enu_m[far], wall_with_gap()) >= PARAMS.radius_m - 1e-6


def test_a_start_outside_the_bounds_widens_them():
    start = np.array([-9.0, 0.0, 0.5])
    problem = posed(empty_snapshot(), start)
    assert problem.grid.bounds_enu_m.tolist() == [-9, -12, 0.5, 25, 12, 10]


def test_rrt_star_is_no_longer_than_rrt():
    problem = posed(wall_with_gap())
    seeds = range(5)
    star = np.mean([planners.find("rrtstar").plan(problem, s).length_m for s in seeds])
    plain = np.mean([planners.find("rrt").plan(problem, s).length_m for s in seeds])
    shortest = 2 * np.hypot(10.2, 4 + PARAMS.radius_m)
    assert star < 0.95 * plain
    assert star < 1.1 * shortest


def test_names_are_found_however_they_are_written():
    for written in ("RRT*", "rrt-star", "RRTStar", "rrt_star"):
        assert planners.find(written).name == "rrtstar"


def test_an_unknown_name_names_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'rrtconnect'"):
        planners.find("rrtconect")


def test_other_packages_plug_in_by_entry_point(monkeypatch):
    class Straight:
        name = "straight"

        def plan(self, problem, seed):
            return None

    class Entry:
        name = "straight"

        def load(self):
            return Straight

    monkeypatch.setattr(registry, "entry_points", lambda group: [Entry()])
    assert "straight" in planners.names()
    assert isinstance(planners.find("straight"), Straight)


@pytest.mark.parametrize("spelling", ["rrt-star", "RRT*", "rrt_star", "RRTstar", "rrtstar"])
def test_a_mission_keeps_the_one_name_of_a_planner(spelling):
    """So that flights are grouped together, and paired, whatever was typed."""
    from mavfi_cli.mission.config import MissionConfig

    assert MissionConfig(planner=spelling).to_dict()["planner"] == "rrtstar"
    assert MissionConfig(planner="Straight-Up").planner == "Straight-Up"  # a plug-in's own
