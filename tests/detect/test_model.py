import json
from importlib.metadata import EntryPoint, EntryPoints, entry_points

import numpy as np
import pytest
from detect_builders import RANGES, STACK

from mavfi_cli.core import installed
from mavfi_cli.core.errors import ConfigError, ModelError
from mavfi_cli.detect import base
from mavfi_cli.detect.base import Model, shipped
from mavfi_cli.detect.gaussian import GaussianDetector
from mavfi_cli.detect.preprocess import PreprocessParams

OURS = ["gad", "aad", "range", "l2"]
STACKS = ["hardened", "mavbench", "mavbench-replica"]


@pytest.fixture
def path(tmp_path):
    arrays = {name: np.array(array) for name, array in GaussianDetector.cold(6.0).memory.items()}
    arrays["mean"][3] = 1 / 3
    made = Model(detector="gad", arrays=arrays, stack=STACK, extended=RANGES, provenance={"a": 1})
    made.save(tmp_path / "gad.json")
    return tmp_path / "gad.json"


def changed(path, **values):
    data = json.loads(path.read_text())
    for key, value in values.items():
        if value is None:
            del data[key]
        else:
            data[key] = value
    path.write_text(json.dumps(data))


def test_what_is_saved_is_loaded_exactly(path):
    loaded = Model.read(path)
    assert (
        loaded.arrays["mean"][3] == base.find_detector("gad", model=path).memory["mean"][3] == 1 / 3
    )
    assert loaded.provenance == {"a": 1}
    assert (loaded.stack, loaded.extended) == (STACK, RANGES)
    assert Model.read(path).preprocess == PreprocessParams()
    again = path.with_name("again.json")
    loaded.save(again)
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"schema": 1}, "model schema must be 2, got 1"),
        ({"mavfi": "0.1.0"}, "must be made for mavfi '"),
        ({"stack": "mavbench"}, "corrupt model file: stack: "),
        ({"stack": {"name": "mavbench"}}, "stack.digest: .*missing"),
        ({"stack": {"name": "mavbench", "digest": 1}}, "stack.digest: .*got 1"),
        ({"stack": None}, "unknown keys stack"),
        ({"extended": {}}, "collision, plan_trajectory_seq, plan_future"),
        ({"extended": {**RANGES, "collision": [0]}}, "extended.collision: "),
        ({"extended": {**RANGES, "collision": [1, 2]}}, "extended: collision "),
        ({"extended": {**RANGES, "collision": [0, 0.5]}}, "collision.1.: .*whole number"),
        ({"extended": {**RANGES, "collision": [0, 40000]}}, "extended: collision "),
        ({"detector": "aad"}, "'gad', got 'aad'"),
        ({"states": "0" * 64}, "table of states"),
        ({"preprocess_digest": "0" * 64}, "another preprocessing"),
        ({"preprocess": {"yaw_floor": 1.5}}, "preprocess.yaw_floor: "),
        ({"preprocess": {"nonsense": 1}}, "preprocess.nonsense: unknown"),
        ({"preprocess": [1]}, "preprocess: .*table, got"),
        ({"preprocess": {"yaw_floor": -1}}, "preprocess: .*missing"),
        ({"preprocess": {"position_floor": 5000}}, "corrupt model file: preprocess"),
        ({"provenance": []}, "provenance: .*table, got"),
        ({"provenance": None}, "unknown keys provenance"),
        ({"extra": 1}, "unknown keys extra"),
        ({"arrays": {}}, "arrays must be n_sigma, sigma_floor"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_in_one_line(path, values, problem):
    changed(path, **values)
    with pytest.raises(ModelError, match=problem) as caught:
        base.find_detector("gad", model=path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ([1.0, 2.0], r"'n_sigma' .*\(1,\), got \(2,\)"),
        (["a"], "'n_sigma' .*numbers"),
        ([None], "must be finite"),
        ([[1.0], [2.0, 3.0]], "numbers"),
        ([float("inf")], "must be finite"),
    ],
)
def test_arrays_are_checked(path, value, problem):
    data = json.loads(path.read_text())
    data["arrays"]["n_sigma"] = value
    path.write_text(json.dumps(data))
    with pytest.raises(ModelError, match=problem):
        base.find_detector("gad", model=path)


@pytest.mark.parametrize(
    ("name", "array"),
    [("gad", "n_sigma"), ("gad", "sigma_floor"), ("aad", "threshold"), ("aad", "scale"),
     ("l2", "threshold"), ("l2", "scale"), ("range", "margin")],
)  # fmt: skip
@pytest.mark.parametrize("value", [0.0, -2.0])
def test_thresholds_and_divisors_out_of_range_are_refused(tmp_path, name, array, value):
    data = json.loads(shipped(name).read_text())
    data["arrays"][array][-1] = value
    path = tmp_path / "odd.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ModelError, match=f"array '{array}' must be above 0, got"):
        base.find_detector(name, model=path)


@pytest.mark.parametrize("content", [b"", b"{", b"[1, 2]", b"\xff\xfe", b"null", b"[" * 100000])
def test_a_corrupt_file_is_refused(tmp_path, content):
    path = tmp_path / "broken.json"
    path.write_bytes(content)
    for load in (lambda: base.find_detector("gad", model=path), lambda: Model.read(path)):
        with pytest.raises(ModelError, match="corrupt model file") as caught:
            load()
        assert "\n" not in str(caught.value)


def test_a_number_that_is_not_finite_overwrites_nothing(path):
    before = path.read_bytes()
    loaded = Model.read(path)
    loaded.arrays["mean"][0] = np.nan
    with pytest.raises(ModelError, match="array 'mean' must be finite"):
        loaded.save(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("value", [0, -2.0, float("nan"), float("inf")])
def test_thresholds_out_of_range(value):
    with pytest.raises(ConfigError, match=r"n sigma: .*above 0"):
        base.checked_threshold(value, "n sigma")


def test_a_model_of_version_0_1_is_refused_by_its_schema(path):
    changed(path, schema=1, mavfi="0.1.0", stack=None, extended=None)
    with pytest.raises(ModelError, match="model schema must be 2, got 1"):
        base.find_detector("gad", model=path)


def test_models_are_shipped_for_these_stacks():
    for name in OURS:
        assert all(shipped(name, stack).is_file() for stack in STACKS)
        assert base.find_detector(name).stack.name == base.DEFAULT_STACK


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("name", OURS)
def test_the_shipped_models_tell_where_they_come_from(name, stack):
    path = shipped(name, stack)
    detector = base.find_detector(name, model=path)
    loaded = Model.read(path)
    assert loaded.stack.name == stack
    assert (detector.stack, detector.extended) == (loaded.stack, loaded.extended)
    assert Model.read(path).preprocess == PreprocessParams()
    told = loaded.provenance
    assert told["worlds"] == ["train-0.05-3", "train-0.05-5", "train-0.2-3", "train-0.2-5"]
    parts = [set(told["split"][part]) for part in ("train", "validation", "threshold")]
    assert sum(len(part) for part in parts) == len(set.union(*parts)) == told["flights"] >= 100
    assert told["threshold"] == detector.threshold


def test_a_plug_in_that_does_not_load_has_a_row_of_its_own(monkeypatch):
    gone = EntryPoint("gone", "nowhere_at_all:Gone", base.PLUG_INS.group)
    monkeypatch.setattr(
        installed, "entry_points", lambda group: EntryPoints([*entry_points(group=group), gone])
    )
    found = installed.PlugIns(base.PLUG_INS.group, "detector")
    monkeypatch.setattr(base, "PLUG_INS", found)
    rows = {row.name: row for row in base.listing()}
    assert "plug-in 'gone'" in rows["gone"].description
    assert {"gad", "aad", "range", "l2"} < set(rows)
