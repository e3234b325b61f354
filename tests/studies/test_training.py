"""`mavfi train` on a small scale: ten of the shipped models' own flights, flown and fitted anew."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.detect import base
from mavfi_cli.detect.base import Model, shipped
from mavfi_cli.detect.offline import Dataset

STACK, WORLD, FIRST_SEED, FLIGHTS = "hardened", "train-0.05-3", 10_000, 10
FLOWN = {f"{WORLD}/{seed}" for seed in range(FIRST_SEED, FIRST_SEED + FLIGHTS)}
KINDS = ["gad", "l2", "range"]


@pytest.fixture(scope="module")
def folder(mavfi, tmp_path_factory):
    """Where the small training was done."""
    out = tmp_path_factory.mktemp("small") / "training"
    done = mavfi(
        "train", "--stack", STACK, "--world", WORLD,
        "--first-seed", FIRST_SEED, "--flights", FLIGHTS,
        *(word for kind in KINDS for word in ("--kind", kind)), "--out", out, "--quiet",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return out


def flights_of(told):
    return {flight for part in told["split"].values() for flight in part}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_shipped_and_new_are_of_the_same_version_and_tell_the_same_things(folder, kind):
    new, ours = (
        json.loads(path.read_text()) for path in (folder / f"{kind}.json", shipped(kind, STACK))
    )
    for key in ("schema", "mavfi", "states", "preprocess", "preprocess_digest", "detector"):
        assert new[key] == ours[key]
    assert set(new["arrays"]) == set(ours["arrays"])
    assert set(new["provenance"]) == set(ours["provenance"])
    assert flights_of(new["provenance"]) == FLOWN <= flights_of(ours["provenance"])
    for package in ("numpy", "python"):
        assert new["provenance"]["versions"][package]
        assert ours["provenance"]["versions"][package]


@pytest.mark.slow
def test_the_flights_are_still_those_that_the_shipped_ranges_and_scales_were_made_of(folder):
    new, ours = (
        base.find_detector("range", model=p).memory
        for p in (folder / "range.json", shipped("range", STACK))
    )
    assert (new["lowest"] >= ours["lowest"]).all()
    assert (new["highest"] <= ours["highest"]).all()
    assert (new["highest"] > 0.0).any()
    new, ours = (
        base.find_detector("l2", model=p).memory for p in (folder / "l2.json", shipped("l2", STACK))
    )
    assert (new["scale"] <= ours["scale"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*KINDS, "aad"])
def test_no_flight_that_set_a_shipped_threshold_exceeds_it(folder, kind):
    model = shipped(kind, STACK)
    detector = base.find_detector(kind, model=model)
    setting = set(Model.read(model).provenance["split"]["threshold"]) & FLOWN
    flights = Dataset.load(folder / "dataset.parquet").flights
    scores = [
        flight.scores(detector) for flight in flights if f"{flight.world}/{flight.seed}" in setting
    ]
    assert len(scores) == len(setting) > 0
    assert np.concatenate(scores).max() <= detector.threshold


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--flights", "2"], ".* flights .*at least 10, got 8"),
        (["--kind", "gud"], "--kind: .*'gud'.* 'gad'.* aad, gad, l2, range"),
        (["--n-sigma", "-1"], "Invalid .*'--n-sigma': -1.0 .* 1e-06<=x<=1000000.0"),
        (["--seed", "-1"], "Invalid .*'--seed': -1 .* 0<=x<=2147483647"),
        (["--firmware", "px4"], "--firmware .*--autopilot px4 or ardupilot"),
        (["--autopilot", "px4"], "--firmware: px4 .*--firmware PATH, or PX4_SITL"),
    ],
)
def test_what_cannot_be_fitted_to_is_said_before_anything_is_flown(
    mavfi, tmp_path, monkeypatch, words, problem
):
    monkeypatch.delenv("PX4_SITL", raising=False)
    done = mavfi("train", *words, "--out", tmp_path / "training", "--quiet")
    code = 2 if problem.startswith(("--kind", "--firmware", "Invalid")) else 1
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (code, "", 1)
    assert re.match(f"error: {problem}", done.stderr)
    assert not (tmp_path / "training").exists()


@pytest.fixture
def flown(short_flight, tmp_path):
    """A folder of ten copies of an error-free flight, and of three that are none of the stack."""
    wrong = {"outcome": "timeout"}, {"fault": {"target": "planning"}}, {"stack": "mavbench"}
    for number, changes in enumerate([{}] * 8 + [{"autopilot": "px4"}] * 2 + list(wrong)):
        copy = shutil.copytree(short_flight.path, tmp_path / "runs" / f"link-5-{number:03}")
        result = json.loads((copy / "result.json").read_text())
        section = result if "outcome" in changes else result["config"]
        section.update(changes)
        (copy / "result.json").write_text(json.dumps(result))
    return tmp_path / "runs"


def test_a_detector_is_fitted_to_the_error_free_flights_of_a_folder(mavfi, flown, tmp_path):
    line = ("train", "--flown", flown, "--kind", "gad", "--out", tmp_path / "new", "--quiet")
    done = mavfi(*line, "--stack", "hardened")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Data set    10 flights of hardened, ")
    assert "; left out: 3\n" in done.stdout
    told = Model.read(tmp_path / "new" / "gad.json")
    assert told.stack.name == "hardened"
    assert {"farm/5", "link-5-009/5"} <= flights_of(told.provenance)
    assert told.provenance["autopilot"] == "ours, px4"


def test_a_folder_without_flights_of_the_stack_is_told(mavfi, flown):
    done = mavfi("train", "--flown", flown, "--stack", "mavbench-release", "--quiet")
    assert done.returncode == 1
    assert re.fullmatch(f"error: {flown}: .*13 runs .*'mavbench-release'\n", done.stderr)


def test_what_would_be_flown_means_nothing_with_flown(mavfi, flown):
    done = mavfi("train", "--flown", flown, "--flights", "30")
    assert done.returncode == 2
    assert re.fullmatch("error: --flights .* --flown\n", done.stderr)


@pytest.mark.slow
def test_a_model_of_a_users_companion_guards_its_flights(mavfi, tmp_path):
    program = Path(__file__).parents[2] / "examples" / "companions" / "lockstep.py"
    companion = tmp_path / "north.toml"
    companion.write_text(
        f"time = 'lockstep'\n[program.north]\ncommand = '{sys.executable} {program} {{link}}'\n"
        "[success]\nlanded = true\n"
    )
    out = tmp_path / "gate"
    line = ["train", "--companion", companion, "--world", "farm", "--flights", 10]
    done = mavfi(*line, "--kind", "range", "--out", out, "--quiet")
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "range.json").read_text())["stack"]["name"] == "companion:north"
    line = ["fly", "--companion", companion, "--world", "farm", "--detector", "range"]
    line += ["--model", out / "range.json", "--no-picture", "--quiet", "--json"]
    done = mavfi(*line, "--out", tmp_path / "runs")
    result = json.loads(done.stdout)
    assert result["outcome"] == "success"
    assert result["detection"]["checks"]["setpoint"] > 100
    assert result["detection"]["alarm_count"] == 0
