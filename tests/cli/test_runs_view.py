"""What a person sees while kernels are attacked."""

import sys

from mavfi_cli.cli.runs_view import PlainRuns, runs_view


def test_plain_lines_where_a_kernel_begins_every_ten_seconds_and_at_the_end(capsys):
    now_s = [0.0]
    view = PlainRuns(["octomap", "control"], 50, lambda: now_s[0])
    for kernel in ("octomap", "control"):
        for done in range(51):
            view.show(kernel, done)
            now_s[0] += 0.5
    assert capsys.readouterr().err.splitlines() == [
        "octomap: golden run and profile",
        "octomap: 20/50 runs; 20/100 in all",
        "octomap: 40/50 runs; 40/100 in all",
        "control: golden run and profile",
        "control: 20/50 runs; 70/100 in all",
        "control: 40/50 runs; 90/100 in all",
        "control: 50/50 runs; 100/100 in all",
    ]


def test_without_a_terminal_it_is_lines(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    with runs_view(["control"], 2) as view:
        for done in range(3):
            view.show("control", done)
    assert capsys.readouterr().err.splitlines() == [
        "control: golden run and profile", "control: 2/2 runs; 2/2 in all",
    ]  # fmt: skip


def test_on_a_terminal_it_is_a_bar_that_ends_full(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with runs_view(["octomap", "control"], 2) as view:
        for kernel in ("octomap", "control"):
            for done in range(3):
                view.show(kernel, done)
    err = capsys.readouterr().err
    assert "golden run" not in err
    assert "100%" in err


def test_what_goes_on_before_the_first_run_is_said_every_ten_seconds(capsys):
    now_s = [0.0]
    view = PlainRuns(["octomap"], 2, lambda: now_s[0])
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


def test_on_a_terminal_it_stands_beside_the_bar(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with runs_view(["octomap"], 1) as view:
        view.show("octomap", 0)
        view.stage("golden runs")
        view.stage("profile, 10 instructions stepped")
        view.show("octomap", 1)
    frames = capsys.readouterr().err.split("\r")
    told = [frame for frame in frames if "octomap: " in frame]
    assert ["golden runs" in each for each in told] == [True, False]
    assert "octomap: profile, 10 instructions stepped" in told[-1]
