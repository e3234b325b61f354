"""What every planner must do, whoever wrote it."""

from __future__ import annotations

import itertools
import subprocess
import sys

import fcl
import numpy as np
import pytest

from mavfi_cli.autonomy import planners
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.planners import PlanningParams, PlanningProblem, pose_problem
from mavfi_cli.core.types import FloatArray

RESOLUTION_M = 0.2
PARAMS = PlanningParams()
BOUNDS = np.array([-5.0, -12.0, 1.0, 25.0, 12.0, 10.0])
START, GOAL = np.array([0.0, 0.0, 5.0]), np.array([20.0, 0.0, 5.0])
Corner = tuple[float, float, float]


def _slab(low: Corner | FloatArray, high: Corner | FloatArray) -> FloatArray:
    """Points that fill the voxels of a box."""
    axes = [
        np.arange(a, b, RESOLUTION_M) + 0.5 * RESOLUTION_M for a, b in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def wall_with_gap(gap_m: float = 4.0) -> MapSnapshot:
    """A wall across all of the bounds but for a gap at y = 6."""
    below = _slab((10, -13, 0), (10.4, 6 - gap_m / 2, 11))
    above = _slab((10, 6 + gap_m / 2, 0), (10.4, 13, 11))
    return MapSnapshot.of_points(np.vstack([below, above]))


def _closed_box(around: FloatArray, half: float = 3.0) -> MapSnapshot:
    """Six walls round a point."""
    faces = []
    for axis in range(3):
        for side in (-half, half):
            low, high = around - half, around + half + RESOLUTION_M
            low[axis] = around[axis] + side
            high[axis] = low[axis] + RESOLUTION_M
            faces.append(_slab(low, high))
    return MapSnapshot.of_points(np.vstack(faces))


def posed(
    snapshot: MapSnapshot,
    start: FloatArray = START,
    goal: FloatArray = GOAL,
    params: PlanningParams = PARAMS,
) -> PlanningProblem:
    """Return the problem between start and goal, (3,), ENU, m, in a map."""
    return pose_problem(snapshot, start, goal, BOUNDS, params)


def _clearance(path: FloatArray, snapshot: MapSnapshot) -> float:
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


class PlannerContract:
    """The suite that every registered planner passes.

    Attributes:
        planner: Name of the planner's entry point, set by the subclass.
    """

    planner: str

    @pytest.fixture
    def name(self) -> str:
        """Return the name of the planner under test."""
        return self.planner

    def test_finds_the_gap_and_keeps_its_distance(self, name: str) -> None:
        snapshot = wall_with_gap()
        for seed in range(3):
            result = planners.find(name).plan(posed(snapshot), seed)
            assert result.found, result.reason
            np.testing.assert_array_equal(result.path_enu_m[0], START)
            np.testing.assert_array_equal(result.path_enu_m[-1], GOAL)
            assert (result.path_enu_m >= BOUNDS[:3]).all()
            assert (result.path_enu_m <= BOUNDS[3:]).all()
            assert _clearance(result.path_enu_m, snapshot) >= PARAMS.radius_m - 1e-6

    def test_is_a_function_of_problem_and_seed(self, name: str) -> None:
        problem = posed(wall_with_gap())
        planner = planners.find(name)
        first = planner.plan(problem, 7).path_enu_m
        for other in planners.names():
            planners.find(other).plan(posed(wall_with_gap(5.0)), 3)
        assert np.array_equal(planner.plan(problem, 7).path_enu_m, first)

    def test_repeats_in_another_process(self, name: str) -> None:
        code = (
            "from mavfi_cli.testing.planners import planners, posed, wall_with_gap\n"
            f"result = planners.find({name!r}).plan(posed(wall_with_gap()), 7)\n"
            "print(result.path_enu_m.tobytes().hex())"
        )
        other = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
        )
        here = planners.find(name).plan(posed(wall_with_gap()), 7)
        assert other.stdout.strip() == here.path_enu_m.tobytes().hex()

    def test_a_closed_box_is_an_honest_failure(self, name: str) -> None:
        result = planners.find(name).plan(posed(_closed_box(START)), 1)
        assert not result.found
        assert len(result.path_enu_m) == 0
        assert result.reason
        # Nearest it can come to the goal is the inside of the box.
        assert 17.0 < result.nearest_m <= 20.0

    def test_free_sight_is_flown_straight(self, name: str) -> None:
        result = planners.find(name).plan(posed(MapSnapshot.empty()), 1)
        assert result.found
        assert result.length_m == pytest.approx(20.0, rel=0.01)

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
    def test_impossible_ends_are_reported(
        self, name: str, start: Corner, goal: Corner, reason: str
    ) -> None:
        problem = posed(wall_with_gap(), np.array(start, float), np.array(goal, float))
        result = planners.find(name).plan(problem, 1)
        assert (result.found, result.reason) == (False, reason)

    def test_a_start_too_close_to_a_wall_can_leave(self, name: str) -> None:
        start = np.array([9.5, 0.0, 5.0])  # half a metre from the wall, less than the radius
        result = planners.find(name).plan(posed(wall_with_gap(), start), 2)
        assert result.found, result.reason
        far = np.linalg.norm(result.path_enu_m - start, axis=1) > PARAMS.escape_radius_m + 0.2
        assert _clearance(result.path_enu_m[far], wall_with_gap()) >= PARAMS.radius_m - 1e-6
