"""Which missions an evaluation flies."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from mavfi_cli.core.errors import ConfigError, ModelError, UnknownName
from mavfi_cli.core.types import BY_NAME, DType
from mavfi_cli.detect.base import Model
from mavfi_cli.detect.gaussian import GaussianDetector
from mavfi_cli.detect.preprocess import EXTENDED
from mavfi_cli.spec.stack import load_stack
from mavfi_cli.studies.evaluate import INTEGER, NONE, EvaluationPlan

PLAN = EvaluationPlan(
    worlds=("dense", "farm"), detectors=(NONE, "gad"), flights=2, harmless_flights=1,
    golden_flights=3,
)  # fmt: skip


@pytest.fixture
def models(tmp_path):
    """A folder with a Gaussian model that was made with seeds 40 and 41."""
    arrays = {name: np.array(value) for name, value in GaussianDetector.cold().memory.items()}
    split = {"train": ["train-0.05-3/40"], "threshold": ["train-0.2-5/41"]}
    model = Model(
        detector="gad", arrays=arrays, stack=load_stack("mavbench").mark,
        extended=dict.fromkeys((state.name for state in EXTENDED), (0, 1)),
        provenance={"split": split, "flights": 2},
    )  # fmt: skip
    model.save(tmp_path / "gad.json")
    return tmp_path


def test_every_fault_has_its_golden_pair():
    bare = PLAN.missions()
    golden = [mission for mission in bare if mission.labels["kind"] == "error-free"]
    faulty = [mission for mission in bare if mission.labels["kind"] == "fault"]
    assert len(golden) == 2 * 3
    assert len(faulty) == 2 * 2 * 11
    assert {mission.pair for mission in faulty} < {mission.pair for mission in golden}
    assert all(mission.config.detector is None for mission in bare)
    assert len({mission.pair for mission in golden}) == len(golden)


def test_every_stage_has_its_bit_fields_and_states_of_the_right_type():
    wide = replace(PLAN, worlds=("farm",), flights=40, golden_flights=40)
    seen = Counter()
    for mission in wide.missions():
        fault = mission.config.fault
        if fault is None:
            continue
        (state,) = fault.draw().states
        stage, field = mission.labels["stage"], mission.labels["field"]
        assert state.stage.value == stage
        assert (state.dtype is not DType.FLOAT64) == (field == INTEGER)
        assert fault.field == ("any" if field == INTEGER else field)
        seen[stage, field] += 1
        seen[state.name] += 1
    assert {count for name, count in seen.items() if isinstance(name, tuple)} == {40}
    assert len([name for name in seen if isinstance(name, tuple)]) == 11
    assert {name for name in seen if isinstance(name, str)} == set(BY_NAME)


def test_faults_differ_from_mission_to_mission_and_with_the_seed():
    def seeds(plan):
        return [m.config.fault.seed for m in plan.missions() if m.config.fault]

    assert len(set(seeds(PLAN))) == len(seeds(PLAN))
    assert seeds(PLAN) == seeds(PLAN)
    assert not set(seeds(PLAN)) & set(seeds(replace(PLAN, seed=2)))


def test_more_flights_keep_the_missions_that_there_were():
    more = {mission.config for mission in replace(PLAN, flights=3, golden_flights=9).missions()}
    assert {mission.config for mission in PLAN.missions()} < more


def test_fewer_bit_fields_leave_the_other_faults_as_they_are():
    few = replace(PLAN, fields=("exponent",))
    assert {place.field for place in few.places()} == {"exponent"}
    assert {mission.config for mission in few.missions()} < {m.config for m in PLAN.missions()}


def test_detectors_fly_harmful_faults_and_the_first_missions_whole():
    last = PLAN.seeds[1]
    harmful = ("farm", last, *PLAN.places()[0])
    missions = PLAN.missions("gad", [harmful])
    kinds = Counter((m.labels["kind"], m.labels["world"], m.labels["seed"]) for m in missions)
    first = PLAN.seeds[0]
    assert kinds["fault", "dense", first] == kinds["fault", "farm", first] == 11
    assert kinds["fault", "dense", last] == 0
    assert kinds["fault", "farm", last] == 1
    assert sum(count for (kind, *_), count in kinds.items() if kind == "error-free") == 6
    assert {m.config.detector.name for m in missions} == {"gad"}
    assert {m.pair for m in missions} == {m.pair for m in PLAN.missions()}


def test_instruction_level_attacks_each_node():
    missions = replace(PLAN, level="instruction").missions()
    targets = Counter(m.config.instruction.target for m in missions if m.config.instruction)
    assert targets == dict.fromkeys(
        ("octomap", "collision_check", "point_cloud", "planner", "control"), 4
    )
    assert all(m.config.fault is None for m in missions)


def test_seeds_that_a_model_was_made_with_are_refused(models):
    plan = replace(PLAN, models=models)
    plan.require_held_out()
    with pytest.raises(ModelError, match=r"gad .* train-0.2-5/41, so seeds 41"):
        replace(plan, first_seed=41).require_held_out()
    with pytest.raises(ModelError, match=r"train-0.05-3/40"):
        replace(plan, first_seed=38).require_held_out()
    replace(plan, first_seed=42).require_held_out()


def test_a_model_that_is_missing_or_damaged_is_refused(models):
    plan = replace(PLAN, models=models)
    with pytest.raises(ModelError, match="no such model file"):
        replace(plan, detectors=("aad",)).require_held_out()
    (models / "gad.json").write_text(json.dumps({"schema": 2}))
    with pytest.raises(ModelError, match="corrupt"):
        plan.require_held_out()


def test_all_parts_of_the_split_are_seen(models):
    flights = Model.read(models / "gad.json").training_flights
    assert sorted(flights) == ["train-0.05-3/40", "train-0.2-5/41"]


@pytest.mark.parametrize(
    ("changes", "error", "told"),
    [
        ({"detectors": ("gda",)}, UnknownName, "did you mean 'gad'"),
        ({"detectors": ()}, ConfigError, "detector: .*at least one"),
        ({"detectors": ("gad", "gad")}, ConfigError, "gad twice"),
        ({"worlds": ("farm", "farm")}, ConfigError, "farm twice"),
        ({"protect": ("palnning",)}, UnknownName, "did you mean 'planning'"),
        ({"level": "gate"}, UnknownName, "level"),
        ({"fields": ("exponnet",)}, UnknownName, "did you mean 'exponent'"),
    ],
)
def test_plans_that_make_no_sense(changes, error, told):
    with pytest.raises(error, match=told):
        replace(PLAN, **changes)
