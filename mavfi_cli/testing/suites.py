"""The contract suites of detectors and planners."""

from __future__ import annotations

import itertools
import pickle
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import fcl
import numpy as np
import pytest
from numpy.typing import NDArray

from mavfi_cli.autonomy import planners
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.planners import PlanningParams, PlanningProblem
from mavfi_cli.core.errors import ConfigError, ModelError
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import FloatArray, Stage
from mavfi_cli.detect import base
from mavfi_cli.detect.base import Detector, FittedDetector
from mavfi_cli.detect.preprocess import COUNT, DETECTED, LIMIT, NAN_CODE
from mavfi_cli.spec.detector import DetectorConfig

Deltas = NDArray[np.int16]
_STAGES = list(Stage)
_PLACES = {state.name: place for place, state in enumerate(DETECTED)}


def _zeros() -> Deltas:
    return np.zeros(COUNT, np.int16)


def _single(place: int, delta: int) -> Deltas:
    deltas = _zeros()
    deltas[place] = delta
    return deltas


def _samples(count: int = 60, seed: int = 3) -> Deltas:
    """Return random deltas of shape (count, COUNT), one sample per row.

    Changes are small, as in flights, except in every tenth sample.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.integers(-2, 3, size=(count, COUNT)) * (rng.random((count, COUNT)) < 0.2)
    drawn[::10] *= 100
    return drawn.astype(np.int16)


def _alarms(detector: Detector, deltas: Deltas, stage: Stage) -> bool:
    return not detector.score(deltas, stage) <= detector.threshold


def _run(detector: Detector, rows: Iterable[Deltas]) -> list[float]:
    scores = []
    for number, deltas in enumerate(rows):
        stage = _STAGES[number % 3]
        scores.append(detector.score(deltas, stage))
        if not scores[-1] > detector.threshold:
            detector.learn(deltas, stage)
    return scores


class DetectorContract:
    """The tests that every registered detector must pass. Subclass it to test a detector.

    Attributes:
        detector: Name of the detector's entry point, set by the subclass.
    """

    detector: str

    @pytest.fixture
    def name(self) -> str:
        """Return the name of the detector under test."""
        return self.detector

    def test_says_who_it_is(self, name: str) -> None:
        detector = base.find_detector(name)
        assert detector.name == name
        assert isinstance(detector.per_stage, bool)
        assert np.isfinite(detector.threshold)

    def test_is_deterministic(self, name: str) -> None:
        assert _run(base.find_detector(name), _samples()) == _run(
            base.find_detector(name), _samples()
        )

    @pytest.mark.parametrize("stage", _STAGES)
    def test_no_change_is_no_alarm(self, name: str, stage: Stage) -> None:
        detector = base.find_detector(name)
        for _ in range(50):
            assert not _alarms(detector, _zeros(), stage)
            detector.learn(_zeros(), stage)

    @pytest.mark.parametrize("place", range(COUNT), ids=[state.name for state in DETECTED])
    @pytest.mark.parametrize("delta", [1000, -1000, LIMIT, -LIMIT])
    def test_an_extreme_change_of_any_state_is_an_alarm(
        self, name: str, place: int, delta: int
    ) -> None:
        assert _alarms(base.find_detector(name), _single(place, delta), DETECTED[place].stage)

    @pytest.mark.parametrize("place", range(COUNT), ids=[state.name for state in DETECTED])
    def test_a_state_that_became_nan_is_an_alarm(self, name: str, place: int) -> None:
        assert _alarms(base.find_detector(name), _single(place, NAN_CODE), DETECTED[place].stage)

    def test_a_stage_is_blind_to_the_others_if_it_is_judged_alone(self, name: str) -> None:
        detector = base.find_detector(name)
        for place, state in enumerate(DETECTED):
            for stage in set(Stage) - {state.stage}:
                assert _alarms(detector, _single(place, 1000), stage) is not detector.per_stage

    def test_scoring_changes_nothing(self, name: str) -> None:
        detector = base.find_detector(name)
        before = {key: array.copy() for key, array in detector.memory.items()}
        for deltas in _samples():
            given = deltas.copy()
            detector.score(deltas, Stage.CONTROL)
            np.testing.assert_array_equal(deltas, given)
        assert set(detector.memory) == set(before)
        for key, array in detector.memory.items():
            np.testing.assert_array_equal(array, before[key])

    def test_memory_is_all_that_decides(self, name: str) -> None:
        taught, fresh = base.find_detector(name), base.find_detector(name)
        _run(taught, _samples())
        assert set(fresh.memory) == set(taught.memory)
        for key, array in fresh.memory.items():
            array[...] = taught.memory[key]
        assert _run(fresh, _samples(seed=4)) == _run(taught, _samples(seed=4))
        assert fresh.threshold == taught.threshold

    def test_a_flip_in_the_threshold_changes_decisions(self, name: str) -> None:
        detector = base.find_detector(name, threshold=4.0)
        change = _single(_PLACES["command_vx"], 1000)
        assert _alarms(detector, change, Stage.CONTROL)
        holders = [
            array for array in detector.memory.values()
            if array.dtype == np.float64 and (array.ravel() == detector.threshold).any()
        ]  # fmt: skip
        assert holders, "the threshold is part of the memory"
        for array in holders:
            flat = array.reshape(-1).view(np.uint64)
            flat[array.reshape(-1) == detector.threshold] ^= np.uint64(1 << 61)
        assert detector.threshold > 1e100
        assert not _alarms(detector, change, Stage.CONTROL)

    def test_a_broken_memory_is_never_silent(self, name: str) -> None:
        """A score that depends on a NaN in the detector's memory raises an alarm."""
        for key in base.find_detector(name).memory:
            for place in range(base.find_detector(name).memory[key].size):
                healthy, broken = base.find_detector(name), base.find_detector(name)
                if broken.memory[key].dtype.kind != "f":
                    continue
                broken.memory[key].reshape(-1)[place] = np.nan
                for state_place, state in enumerate(DETECTED):
                    change = _single(state_place, 1000)
                    assert _alarms(healthy, change, state.stage)
                    assert _alarms(broken, change, state.stage), (key, place, state.name)

    def test_pickles_with_what_it_has_learned(self, name: str) -> None:
        detector = base.find_detector(name)
        _run(detector, _samples())
        twin = pickle.loads(pickle.dumps(detector))
        assert _run(twin, _samples(seed=5)) == _run(detector, _samples(seed=5))
        if isinstance(detector, FittedDetector):
            assert (twin.stack, twin.extended) == (detector.stack, detector.extended)
        for array in twin.memory.values():  # the twin decides by its own memory
            array[...] = np.nan if array.dtype.kind == "f" else 0
        assert np.isfinite(detector.threshold)
        assert _alarms(twin, _single(0, 1000), Stage.PERCEPTION)

    def test_the_threshold_can_be_given_within_bounds(self, name: str) -> None:
        assert base.find_detector(name, threshold=7.5).threshold == 7.5
        for bad in (0.0, -1.0, float("nan"), float("inf")):
            with pytest.raises(ConfigError, match=r"must be a finite number above 0, got"):
                base.find_detector(name, threshold=bad)

    def test_a_model_that_is_not_there_is_an_error(self, name: str, tmp_path: Path) -> None:
        with pytest.raises(ModelError, match=r"none\.json: "):
            base.find_detector(name, model=tmp_path / "none.json")

    def test_a_mission_takes_the_model_of_its_stack_or_needs_none(self, name: str) -> None:
        for stack in ("mavbench", "hardened"):
            detector = DetectorConfig(name=name).build(stack)
            if isinstance(detector, FittedDetector):
                assert detector.stack is not None
                assert detector.stack.name == stack

    def test_no_model_flies_a_stack_that_it_was_not_fitted_to_unless_allowed(
        self, name: str
    ) -> None:
        config = DetectorConfig(name=name, any_stack=True)
        assert config.build("mavbench-release").name == name
        if isinstance(base.find_detector(name), FittedDetector):
            with pytest.raises(ModelError, match="mavfi train --stack mavbench-release"):
                DetectorConfig(name=name).build("mavbench-release")
        else:
            assert DetectorConfig(name=name).build("mavbench-release").name == name

    def test_extended_states_need_the_ranges_of_a_model(self, name: str) -> None:
        config = DetectorConfig(name=name, watch="extended")
        if isinstance(base.find_detector(name), FittedDetector):
            assert config.build("mavbench").name == name
        else:
            with pytest.raises(
                ConfigError, match=f"needs the state ranges of a fitted model, but {name} has none"
            ):
                config.build("mavbench")


# Planners -----------------------------------------------------------------------------------------

RESOLUTION_M = 0.2
PARAMS = PlanningParams()
BOUNDS = np.array([-5.0, -12.0, 1.0, 25.0, 12.0, 10.0])
START, GOAL = np.array([0.0, 0.0, 5.0]), np.array([20.0, 0.0, 5.0])
Corner = tuple[float, float, float]


def _slab(low: Corner | FloatArray, high: Corner | FloatArray) -> FloatArray:
    axes = [
        np.arange(a, b, RESOLUTION_M) + 0.5 * RESOLUTION_M for a, b in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _closed_box(around: FloatArray, half: float = 3.0) -> MapSnapshot:
    faces = []
    for axis in range(3):
        for side in (-half, half):
            low, high = around - half, around + half + RESOLUTION_M
            low[axis] = around[axis] + side
            high[axis] = low[axis] + RESOLUTION_M
            faces.append(_slab(low, high))
    return MapSnapshot.of_points(np.vstack(faces))


def _clearance(path: FloatArray, snapshot: MapSnapshot) -> float:
    """Return the smallest distance, in metres, between a path and the occupied voxels of a map.

    The path is sampled every 5 cm, and the library FCL computes the distances.
    """
    tree = fcl.CollisionObject(fcl.OcTree(snapshot.resolution_m, snapshot.signed_bytes()))
    smallest = np.inf
    for start, end in itertools.pairwise(path):
        steps = max(2, int(norm(end - start) / 0.05))
        for share in np.linspace(0, 1, steps):
            point = fcl.Transform(start + share * (end - start))
            probe = fcl.CollisionObject(fcl.Sphere(1e-3), point)
            distance_m = fcl.distance(probe, tree, fcl.DistanceRequest(), fcl.DistanceResult())
            smallest = min(smallest, distance_m + 1e-3)
    return smallest


class PlannerContract:
    """The tests that every registered planner must pass. Subclass it to test a planner.

    Attributes:
        planner: Name of the planner's entry point, set by the subclass.
    """

    planner: str

    @staticmethod
    def wall_with_gap(gap_m: float = 4.0) -> MapSnapshot:
        """Return a map with a wall across the bounds at x = 10 m that has a gap at y = 6 m.

        Args:
            gap_m: width of the gap.
        """
        below = _slab((10, -13, 0), (10.4, 6 - gap_m / 2, 11))
        above = _slab((10, 6 + gap_m / 2, 0), (10.4, 13, 11))
        return MapSnapshot.of_points(np.vstack([below, above]))

    @staticmethod
    def posed(
        snapshot: MapSnapshot,
        start: FloatArray = START,
        goal: FloatArray = GOAL,
        params: PlanningParams = PARAMS,
    ) -> PlanningProblem:
        """Return the problem of planning a path through a map from a start to a goal.

        Both positions have the shape (3,) and are in ENU, in metres.
        """
        return PlanningProblem.pose(snapshot, start, goal, BOUNDS, params)

    @pytest.fixture
    def name(self) -> str:
        """Return the name of the planner under test."""
        return self.planner

    def test_finds_the_gap_and_keeps_its_distance(self, name: str) -> None:
        snapshot = self.wall_with_gap()
        for seed in range(3):
            result = planners.find(name).plan(self.posed(snapshot), seed)
            assert result.found, result.reason
            np.testing.assert_array_equal(result.path_enu_m[0], START)
            np.testing.assert_array_equal(result.path_enu_m[-1], GOAL)
            assert (result.path_enu_m >= BOUNDS[:3]).all()
            assert (result.path_enu_m <= BOUNDS[3:]).all()
            assert _clearance(result.path_enu_m, snapshot) >= PARAMS.radius_m - 1e-6

    def test_is_a_function_of_problem_and_seed(self, name: str) -> None:
        problem = self.posed(self.wall_with_gap())
        planner = planners.find(name)
        first = planner.plan(problem, 7).path_enu_m
        for other in planners.PLANNERS.names:
            planners.find(other).plan(self.posed(self.wall_with_gap(5.0)), 3)
        assert np.array_equal(planner.plan(problem, 7).path_enu_m, first)

    def test_repeats_in_another_process(self, name: str) -> None:
        code = (
            "from mavfi_cli.autonomy import planners\n"
            "from mavfi_cli.testing import PlannerContract as suite\n"
            "problem = suite.posed(suite.wall_with_gap())\n"
            f"result = planners.find({name!r}).plan(problem, 7)\n"
            "print(result.path_enu_m.tobytes().hex())"
        )
        other = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
        )
        here = planners.find(name).plan(self.posed(self.wall_with_gap()), 7)
        assert other.stdout.strip() == here.path_enu_m.tobytes().hex()

    def test_a_closed_box_is_an_honest_failure(self, name: str) -> None:
        result = planners.find(name).plan(self.posed(_closed_box(START)), 1)
        assert not result.found
        assert len(result.path_enu_m) == 0
        assert result.reason
        # The path can approach the goal only as far as the walls of the box allow.
        assert 17.0 < result.nearest_m <= 20.0

    def test_free_sight_is_flown_straight(self, name: str) -> None:
        result = planners.find(name).plan(self.posed(MapSnapshot.empty()), 1)
        assert result.found
        legs_m = np.linalg.norm(np.diff(result.path_enu_m, axis=0), axis=1)
        assert legs_m.sum() == pytest.approx(20.0, rel=0.01)

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
        problem = self.posed(self.wall_with_gap(), np.array(start, float), np.array(goal, float))
        result = planners.find(name).plan(problem, 1)
        assert (result.found, result.reason) == (False, reason)

    def test_a_start_too_close_to_a_wall_can_leave(self, name: str) -> None:
        start = np.array([9.5, 0.0, 5.0])  # half a metre from the wall, less than the radius
        result = planners.find(name).plan(self.posed(self.wall_with_gap(), start), 2)
        assert result.found, result.reason
        far = np.linalg.norm(result.path_enu_m - start, axis=1) > PARAMS.escape_radius_m + 0.2
        assert _clearance(result.path_enu_m[far], self.wall_with_gap()) >= PARAMS.radius_m - 1e-6
