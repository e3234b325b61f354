"""`mavfi detect`: what is there, and bad input in one line."""

import json
import re
import shutil

import pytest

from mavfi_cli.detect.base import Model, find_detector, shipped


def refused(mavfi, tmp_path, *arguments):
    """The line that an evaluation ends with before anything is flown."""
    done = mavfi("detect", "evaluate", *arguments, "--out", tmp_path / "out", "--quiet")
    (line,) = done.stderr.splitlines()
    code = 2 if re.match("error: --[a-z]+: unknown ", line) else 1
    assert (done.returncode, done.stdout) == (code, "")
    assert not (tmp_path / "out").exists()
    return line


@pytest.mark.parametrize(
    ("option", "given", "told"),
    [
        ("--world", "denze", "'dense'"),
        ("--detector", "gda", "'gad'"),
        ("--protect", "palnning", "'planning'"),
        ("--platform", "x68", "'x86'"),
        ("--models", "nowhere", "no such model file"),
    ],
)
def test_bad_input_gets_one_line(mavfi, tmp_path, option, given, told):
    assert told in refused(mavfi, tmp_path, option, given)


def test_seeds_of_the_training_are_refused_by_name(mavfi, tmp_path):
    flight = Model.read(shipped("gad")).provenance["split"]["train"][0]
    first = flight.split("/")[1]
    line = refused(mavfi, tmp_path, "--detector", "gad", "--first-seed", first)
    assert re.search(f"gad .* train-.* seeds {first} to ", line)


def test_usage_errors(mavfi, tmp_path):
    for words in (("--json", "--csv"), ("--seed", "-1")):
        done = mavfi("detect", "evaluate", *words, cwd=tmp_path)
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert not list(tmp_path.iterdir())


def test_the_list_names_model_threshold_and_training(mavfi):
    listed = json.loads(mavfi("detect", "list", "--json").stdout)
    rows = {(row["name"], row["stack"]): row for row in listed}
    stacks = ("hardened", "mavbench")
    assert {(n, s) for n in ("gad", "aad", "range", "l2") for s in stacks} <= set(rows)
    aad = rows["aad", "mavbench"]
    assert aad["model"] == str(shipped("aad"))
    assert aad["threshold"] == Model.read(shipped("aad")).provenance["threshold"]
    text = mavfi("detect", "list").stdout
    assert f"threshold {aad['threshold']:.6g}" in text
    assert f"{aad['provenance']['flights']} flights in train-0.05-3" in text


def test_the_list_tells_of_a_model_that_cannot_be_used(mavfi, tmp_path):
    shutil.copy(shipped("gad"), tmp_path)
    (tmp_path / "aad.json").write_text("{")
    done = mavfi("detect", "list", "--models", tmp_path)
    assert done.returncode == 0
    assert "cannot be used" in done.stdout
    assert "corrupt model file: not JSON" in done.stdout
    assert f"threshold {find_detector('gad').threshold:g}" in done.stdout
    assert done.stdout.count("No such file or directory") == 2  # l2 and range
