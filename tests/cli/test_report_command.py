"""`mavfi report`: one file, and one line for what is wrong."""

import json
import sys
from pathlib import Path

import pytest

from mavfi_cli.paper.verdicts import Verdict

RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.mark.slow
def test_a_script_gets_the_verdicts_and_what_is_missing_is_on_stderr(command_line, tmp_path):
    (tmp_path / "empty").mkdir()
    page, places = tmp_path / "page.html", (tmp_path / "empty", RESULTS / "instruction.parquet")
    left, out, err = command_line("report", *places, "-o", page, "--json")
    told = json.loads(out)
    assert (left, told["file"], told["missions"]) == (0, str(page), 840)
    assert told["bytes"] == page.stat().st_size
    assert set(told["verdicts"]) == {"mavbench", "hardened", "isolated kernels"}
    known = {verdict.value for verdict in Verdict}
    assert all(set(counts) == known for counts in told["verdicts"].values())
    assert sum(told["verdicts"]["mavbench"].values()) > 0
    verdicts = [
        claim["judgements"]["mavbench"]["all faults"]["verdict"]
        for claim in told["claims"]
        if "mavbench" in claim["judgements"]
    ]
    assert {name: verdicts.count(name) for name in known} == told["verdicts"]["mavbench"]
    assert err.startswith("note: ")
    assert "holds no campaign" in err
    assert "holds no campaign" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("place", "output", "told"),
    [
        ("absent", "page.html", "absent: does not exist"),
        (".", "page.html", "holds no campaign, no export"),
        (str(RESULTS / "README.md"), "page.html", "README.md"),
    ],
)
def test_bad_input_is_one_line(command_line, tmp_path, monkeypatch, place, output, told):
    monkeypatch.chdir(tmp_path)
    left, out, err = command_line("report", place, "-o", output)
    assert (left, out) == (1, "")
    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert told in line
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("output", "told"),
    [
        ("no/where.html", "its folder does not exist"),
        ("/dev/null", "must end in .html or .htm"),
        ("/", "is a directory"),
    ],
)
def test_a_page_that_cannot_be_written_is_wrong_usage(command_line, output, told):
    left, out, err = command_line("report", ".", "-o", output)
    assert (left, out) == (2, "")
    assert err.startswith("error: Invalid value for '-o' / '--output': ")
    assert told in err


def test_a_missing_jinja2_names_the_extra(command_line, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    monkeypatch.setattr(sys, "path_importer_cache", {})
    left, _, err = command_line("report", str(tmp_path), "-o", str(tmp_path / "page.html"))
    assert left == 1
    assert "needs jinja2" in err
    assert "pip install 'mavfi[report]'" in err


def test_a_rate_below_zero_is_wrong_usage(command_line):
    left, _, err = command_line("report", ".", "-o", "page.html", "--upsets", "-1")
    assert left == 2
    assert "--upsets" in err
