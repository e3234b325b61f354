"""`mavfi report`: one file, and one line for what is wrong."""

import json
import sys
from pathlib import Path

import pytest

from mavfi_cli.paper.verdicts import Verdict

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def assert_only_steps(text):
    """A step shows after ten seconds, on a busy machine; an export without builds is noted."""
    assert all(line.endswith(" ...") for line in text.splitlines() if "does not name" not in line)


@pytest.mark.slow
def test_it_writes_one_page(command_line, tmp_path):
    page = tmp_path / "page.html"
    left, out, err = command_line("report", str(RESULTS / "instruction.parquet"), "-o", str(page))
    assert left == 0
    assert_only_steps(err)
    answer, written = out.splitlines()
    assert " of the " in answer
    assert written.startswith(f"840 missions in {page} (")
    assert [each.name for each in tmp_path.iterdir()] == ["page.html"]
    assert page.read_text(encoding="utf-8").rstrip().endswith("</html>")


@pytest.mark.slow
def test_a_script_gets_the_verdicts(command_line, tmp_path):
    page, place = tmp_path / "page.html", RESULTS / "instruction.parquet"
    left, out, err = command_line("report", place, "-o", page, "--json")
    told = json.loads(out)
    assert (left, told["file"], told["missions"]) == (0, str(page), 840)
    assert_only_steps(err)
    assert told["bytes"] == page.stat().st_size
    assert set(told["verdicts"]) == {"mavbench", "hardened", "isolated kernels"}
    known = {verdict.value for verdict in Verdict}
    assert all(set(counts) == known for counts in told["verdicts"].values())
    assert sum(told["verdicts"]["mavbench"].values()) > 0


@pytest.mark.slow
def test_what_is_missing_is_on_stderr_and_in_the_page(command_line, tmp_path):
    (tmp_path / "empty").mkdir()
    page = tmp_path / "page.html"
    left, _, err = command_line(
        "report", str(tmp_path / "empty"), str(RESULTS / "instruction.parquet"), "-o", str(page)
    )
    assert left == 0
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
    [("no/where.html", "its folder does not exist"), ("/dev/null", "not a regular file")],
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
