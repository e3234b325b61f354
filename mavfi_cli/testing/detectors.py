"""What every detector must do, whoever wrote it."""

from __future__ import annotations

import pickle
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mavfi_cli.core.errors import ConfigError, ModelError
from mavfi_cli.core.types import Stage
from mavfi_cli.detect import base
from mavfi_cli.detect.base import Detector
from mavfi_cli.detect.fitted import FittedDetector
from mavfi_cli.detect.preprocess import COUNT, DETECTED, LIMIT, NAN_CODE
from mavfi_cli.spec.detector import DetectorConfig, detector_of

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
    """Return small changes, as flights have them, and a few large ones."""
    rng = np.random.default_rng(seed)
    drawn = rng.integers(-2, 3, size=(count, COUNT)) * (rng.random((count, COUNT)) < 0.2)
    drawn[::10] *= 100
    return drawn.astype(np.int16)


def _alarms(detector: Detector, deltas: Deltas, stage: Stage) -> bool:
    return not detector.score(deltas, stage) <= detector.threshold


def _run(detector: Detector, rows: Iterable[Deltas]) -> list[float]:
    """Return the scores of a stream of samples. The detector learns those that pass."""
    found = []
    for number, deltas in enumerate(rows):
        stage = _STAGES[number % 3]
        found.append(detector.score(deltas, stage))
        if not found[-1] > detector.threshold:
            detector.learn(deltas, stage)
    return found


class DetectorContract:
    """The suite that every registered detector passes.

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
        """A score raises an alarm if any number that it depends on is NaN."""
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
        for (
            array
        ) in twin.memory.values():  # the twin's memory is its own, and is what it decides by
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
            detector = detector_of(DetectorConfig(name=name), stack)
            if isinstance(detector, FittedDetector):
                assert detector.stack is not None
                assert detector.stack.name == stack

    def test_no_model_flies_a_stack_that_it_was_not_fitted_to_unless_that_is_asked_for(
        self, name: str
    ) -> None:
        asked = DetectorConfig(name=name, any_stack=True)
        assert detector_of(asked, "mavbench-release").name == name
        if isinstance(base.find_detector(name), FittedDetector):
            with pytest.raises(ModelError, match="mavfi train --stack mavbench-release"):
                detector_of(DetectorConfig(name=name), "mavbench-release")
        else:
            assert detector_of(DetectorConfig(name=name), "mavbench-release").name == name

    def test_extended_states_need_the_ranges_of_a_model(self, name: str) -> None:
        config = DetectorConfig(name=name, watch="extended")
        if isinstance(base.find_detector(name), FittedDetector):
            assert detector_of(config, "mavbench").name == name
        else:
            with pytest.raises(
                ConfigError, match=f"needs the ranges of a model, and {name} has none"
            ):
                detector_of(config, "mavbench")
