"""What every detector must do, whoever wrote it."""

import pickle

import numpy as np
import pytest

from mavfi_cli.core.errors import ConfigError, ModelError, OtherStack, UnknownName
from mavfi_cli.core.types import Stage
from mavfi_cli.detect import registry
from mavfi_cli.detect.fitted import FittedDetector
from mavfi_cli.detect.preprocess import COUNT, DETECTED, LIMIT, NAN_CODE
from mavfi_cli.mission.detector_config import DetectorConfig, detector_of

every_detector = pytest.mark.parametrize("name", registry.names())
STAGES = list(Stage)


def zeros():
    return np.zeros(COUNT, np.int16)


def single(place, delta):
    deltas = zeros()
    deltas[place] = delta
    return deltas


def samples(count=60, seed=3):
    """Small changes, as flights have them, and a few large ones."""
    rng = np.random.default_rng(seed)
    drawn = rng.integers(-2, 3, size=(count, COUNT)) * (rng.random((count, COUNT)) < 0.2)
    drawn[::10] *= 100
    return drawn.astype(np.int16)


def alarms(detector, deltas, stage):
    return not detector.score(deltas, stage) <= detector.threshold


def run(detector, rows):
    """Scores of a stream of samples, learned from where they pass."""
    found = []
    for number, deltas in enumerate(rows):
        stage = STAGES[number % 3]
        found.append(detector.score(deltas, stage))
        if not found[-1] > detector.threshold:
            detector.learn(deltas, stage)
    return found


def test_ours_are_there():
    assert {"gad", "aad", "range", "l2"} <= set(registry.names())


@every_detector
def test_says_who_it_is(name):
    detector = registry.find(name)
    assert detector.name == name
    assert isinstance(detector.per_stage, bool)
    assert np.isfinite(detector.threshold)


@every_detector
def test_is_deterministic(name):
    assert run(registry.find(name), samples()) == run(registry.find(name), samples())


@every_detector
@pytest.mark.parametrize("stage", STAGES)
def test_no_change_is_no_alarm(name, stage):
    detector = registry.find(name)
    for _ in range(50):
        assert not alarms(detector, zeros(), stage)
        detector.learn(zeros(), stage)


@every_detector
@pytest.mark.parametrize("place", range(COUNT), ids=[state.name for state in DETECTED])
@pytest.mark.parametrize("delta", [1000, -1000, LIMIT, -LIMIT])
def test_an_extreme_change_of_any_state_is_an_alarm(name, place, delta):
    assert alarms(registry.find(name), single(place, delta), DETECTED[place].stage)


@every_detector
@pytest.mark.parametrize("place", range(COUNT), ids=[state.name for state in DETECTED])
def test_a_state_that_became_nan_is_an_alarm(name, place):
    assert alarms(registry.find(name), single(place, NAN_CODE), DETECTED[place].stage)


@every_detector
def test_a_stage_is_blind_to_the_others_if_it_is_judged_alone(name):
    detector = registry.find(name)
    for place, state in enumerate(DETECTED):
        for stage in set(Stage) - {state.stage}:
            assert alarms(detector, single(place, 1000), stage) is not detector.per_stage


@every_detector
def test_scoring_changes_nothing(name):
    detector = registry.find(name)
    before = {key: array.copy() for key, array in detector.memory.items()}
    for deltas in samples():
        given = deltas.copy()
        detector.score(deltas, Stage.CONTROL)
        np.testing.assert_array_equal(deltas, given)
    assert set(detector.memory) == set(before)
    for key, array in detector.memory.items():
        np.testing.assert_array_equal(array, before[key])


@every_detector
def test_memory_is_all_that_decides(name):
    taught, fresh = registry.find(name), registry.find(name)
    run(taught, samples())
    assert set(fresh.memory) == set(taught.memory)
    for key, array in fresh.memory.items():
        array[...] = taught.memory[key]
    assert run(fresh, samples(seed=4)) == run(taught, samples(seed=4))
    assert fresh.threshold == taught.threshold


@every_detector
def test_a_flip_in_the_threshold_changes_decisions(name):
    detector = registry.find(name, threshold=4.0)
    change = single(NAMED["command_vx"], 1000)
    assert alarms(detector, change, Stage.CONTROL)
    holders = [
        array for array in detector.memory.values()
        if array.dtype == np.float64 and (array.ravel() == detector.threshold).any()
    ]  # fmt: skip
    assert holders, "the threshold is part of the memory"
    for array in holders:
        flat = array.reshape(-1).view(np.uint64)
        flat[array.reshape(-1) == detector.threshold] ^= np.uint64(1 << 61)
    assert detector.threshold > 1e100
    assert not alarms(detector, change, Stage.CONTROL)


NAMED = {state.name: place for place, state in enumerate(DETECTED)}


@every_detector
def test_a_broken_memory_is_never_silent(name):
    """With a NaN in any number that a score depends on, that score raises an alarm."""
    for key in registry.find(name).memory:
        for place in range(registry.find(name).memory[key].size):
            healthy, broken = registry.find(name), registry.find(name)
            if broken.memory[key].dtype.kind != "f":
                continue
            broken.memory[key].reshape(-1)[place] = np.nan
            for state_place, state in enumerate(DETECTED):
                change = single(state_place, 1000)
                assert alarms(healthy, change, state.stage)
                assert alarms(broken, change, state.stage), (key, place, state.name)


@every_detector
def test_pickles_with_what_it_has_learned(name):
    detector = registry.find(name)
    run(detector, samples())
    twin = pickle.loads(pickle.dumps(detector))
    assert run(twin, samples(seed=5)) == run(detector, samples(seed=5))
    if isinstance(detector, FittedDetector):
        assert (twin.stack, twin.extended) == (detector.stack, detector.extended)
    for array in twin.memory.values():  # the twin's memory is its own, and is what it decides by
        array[...] = np.nan if array.dtype.kind == "f" else 0
    assert np.isfinite(detector.threshold)
    assert alarms(twin, single(0, 1000), Stage.PERCEPTION)


@every_detector
def test_the_threshold_can_be_given_within_bounds(name):
    assert registry.find(name, threshold=7.5).threshold == 7.5
    for bad in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match=r"must be a finite number above 0, got"):
            registry.find(name, threshold=bad)


@every_detector
def test_a_model_that_is_not_there_is_an_error(name, tmp_path):
    with pytest.raises(ModelError, match=r"none\.json: "):
        registry.find(name, model=tmp_path / "none.json")


@every_detector
def test_a_mission_takes_the_model_of_its_stack_or_needs_none(name):
    for stack in ("mavbench", "hardened"):
        detector = detector_of(DetectorConfig(name=name), stack)
        if isinstance(detector, FittedDetector):
            assert detector.stack.name == stack


@every_detector
def test_no_model_flies_a_stack_that_it_was_not_fitted_to_unless_that_is_asked_for(name):
    asked = DetectorConfig(name=name, any_stack=True)
    assert detector_of(asked, "mavbench-release").name == name
    if isinstance(registry.find(name), FittedDetector):
        with pytest.raises(OtherStack, match="mavfi train --stack mavbench-release"):
            detector_of(DetectorConfig(name=name), "mavbench-release")
    else:
        assert detector_of(DetectorConfig(name=name), "mavbench-release").name == name


@every_detector
def test_extended_states_need_the_ranges_of_a_model(name):
    config = DetectorConfig(name=name, watch="extended")
    if isinstance(registry.find(name), FittedDetector):
        assert detector_of(config, "mavbench").name == name
    else:
        with pytest.raises(ConfigError, match=f"needs the ranges of a model, and {name} has none"):
            detector_of(config, "mavbench")


def test_an_unknown_name_names_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'gad'"):
        registry.find("gaad")
