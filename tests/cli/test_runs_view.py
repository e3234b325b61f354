"""What a person sees while kernels are attacked."""

import re
import sys

import pytest

from mavfi_cli.cli import progress
from mavfi_cli.cli.progress import runs_view


@pytest.fixture
def now_s(monkeypatch):
    """A clock of one element; runs are half a second each."""
    now_s = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s[0])
    return now_s


def test_plain_lines_where_a_kernel_begins_every_ten_seconds_and_at_the_end(capsys, now_s):
    with runs_view(["octomap", "control"], 50) as view:
        for kernel in ("octomap", "control"):
            for done in range(51):
                view.show(kernel, done)
                now_s[0] += 0.5
    lines = capsys.readouterr().err.splitlines()
    assert [(line.partition(":")[0], *re.findall(r"\d[\d/:]+", line)) for line in lines] == [
        ("octomap",), ("octomap", "20/50", "20/100", "0:40"),
        ("octomap", "40/50", "40/100", "0:30"), ("control",),
        ("control", "9/50", "59/100", "0:21"), ("control", "29/50", "79/100", "0:11"),
        ("control", "49/50", "99/100", "0:01"), ("control", "50/50", "100/100"),
    ]  # fmt: skip


def test_what_goes_on_before_the_first_run_is_said_every_ten_seconds(capsys, now_s):
    with runs_view(["octomap"], 2) as view:
        view.show("octomap", 0)
        view.stage("golden runs")
        for steps in range(1, 25):
            now_s[0] += 1.0
            view.stage(f"profile, {steps} instructions stepped")
    assert capsys.readouterr().err.splitlines() == [
        "octomap: golden run and profile",
        "octomap: profile, 10 instructions stepped",
        "octomap: profile, 20 instructions stepped",
    ]


def test_on_a_terminal_one_line_is_rewritten_a_few_times_a_second(capsys, monkeypatch, now_s):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with runs_view(["octomap"], 1000) as view:
        view.note("warning: [sic]")
        for done in range(1001):
            view.show("octomap", done)
            now_s[0] += 0.001
    err = capsys.readouterr().err
    assert "warning: [sic]" in err
    assert "octomap: 1000/1000 runs; 1000/1000 in all" in err
    assert err.count("runs; ") <= 2 * 22
