"""What a person sees while a campaign flies."""

import re
from collections import Counter

import pytest

from mavfi_cli.campaigns.progress import Progress
from mavfi_cli.cli.progress import missions_view


def progress(over, outcomes, **changes):
    values = {
        "total": 100, "before": 0, "over": over, "running": 2, "again": 0,
        "elapsed_s": 36.0,
        "inside_s": 70.0, "workers": 2, "outcomes": outcomes,
    }  # fmt: skip
    return Progress(**(values | changes))


@pytest.fixture
def line_of(capsys):
    def shown(progress):
        with missions_view(quiet=False) as spectator:
            spectator.on_progress(progress)
        return capsys.readouterr().err.rstrip("\n")

    return shown


def test_the_line_tells_missions_rate_time_left_and_the_success_of_each_setting(line_of):
    outcomes = {
        "golden": Counter(success=10),
        "FI": Counter(success=7, collision=1),
        "D&R(G)": Counter(success=1, timeout=1),
        "D&R(A)": Counter(),
    }
    line = line_of(progress(20, outcomes))
    assert line.endswith("(golden 100.0, FI 87.5, D&R(G) 50.0)")
    # Missions, flying, an hour, min to go, % success.
    assert re.findall(r"\d[\d./:]*", line)[:5] == ["20/100", "2", "2000", "2:24", "90.0"]


@pytest.mark.parametrize("settings", [1, 7])
def test_one_setting_or_many_are_told_by_one_rate(line_of, settings):
    outcomes = {f"s{n}": Counter(success=1, collision=1) for n in range(settings)}
    line = line_of(progress(2 * settings, outcomes))
    assert line.endswith(", 50.0 % success")


def test_before_the_first_mission_is_over_there_is_no_rate(line_of):
    assert line_of(progress(0, {"golden": Counter()})) == "0/100 missions, 2 flying"


def test_plain_lines_come_every_ten_seconds_and_at_the_end(capsys):
    with missions_view(quiet=False) as spectator:
        for over in range(0, 101, 10):
            spectator.on_progress(
                progress(over, {"golden": Counter(success=over)}, elapsed_s=over / 4)
            )
        spectator.on_end(progress(100, {"golden": Counter(success=100)}, elapsed_s=25.0))
    lines = capsys.readouterr().err.splitlines()
    begins = ["0/100", "40/100", "80/100", "100/100", "100"]
    assert [line.partition(" ")[0] for line in lines] == begins
    assert re.match("100 missions in 0:25 min, 14400 an hour, 0.0 % ", lines[-1])
