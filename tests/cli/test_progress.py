"""What a person sees while a mission flies."""

import sys

import pytest

from mavfi_cli.cli.progress import progress_view
from mavfi_cli.core.flight_record import Event
from mavfi_cli.mission.progress import FlightProgress
from mavfi_cli.spec.mission import MissionConfig


def tell(config, events=(), quiet=False):
    with progress_view(config, quiet=quiet) as watcher:
        for kind, text in events:
            watcher.on_event(Event(stamp_s=1.5, kind=kind, text=text))
        for stamp_s in range(25):
            watcher.on_progress(
                FlightProgress(stamp_s=float(stamp_s), phase="flying", speed_mps=2.5,
                         goal_distance_m=30.0 if stamp_s < 15 else None, replans=3)
            )  # fmt: skip


@pytest.fixture(params=[False, True], ids=["plain", "terminal"])
def terminal(request, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: request.param, raising=False)
    return request.param


def test_plain_lines_come_every_ten_simulated_seconds(capsys):
    tell(MissionConfig(), [("phase", "offboard"), ("replan", "not told")])
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert lines == [
        "Flying solo in dense, seed 3",
        "   1.50 s  offboard",
        "  10.00 s  flying        30.0 m to go  2.5 m/s  replans 3",
        "  20.00 s  flying       2.5 m/s  replans 3",
    ]


def test_a_note_comes_at_once(capsys, terminal):
    with progress_view(MissionConfig(), quiet=False) as watcher:
        watcher.on_note("compiling [once]")
    assert "compiling [once]" in capsys.readouterr().err


def test_before_anything_happened_nothing_is_said(capsys):
    with progress_view(MissionConfig(), quiet=False):
        pass
    assert capsys.readouterr() == ("", "")


def test_quiet_says_nothing(capsys):
    tell(MissionConfig(), [("phase", "offboard")], quiet=True)
    assert capsys.readouterr() == ("", "")


def test_an_autopilot_may_say_anything(capsys, terminal):
    """Square brackets are markup to rich; here they are an autopilot's words."""
    said = "[/bold] PreArm [red]: [link=x\nb"
    tell(MissionConfig(link="tcp:h:1", goal=(9.0, 0.0, 5.0)), [("autopilot", said)])
    _, err = capsys.readouterr()
    assert said.replace("\n", "\ufffd") in err
    assert "Flying tcp:h:1" in err
