"""`mavfi fly`: what it prints, and with which code it leaves."""

import json
import re
import shlex

import pytest
from missions import RECORD, SHORT_LINE

from mavfi_cli.autonomy import warm
from mavfi_cli.mission import run
from mavfi_cli.mission.run_folder import load_run


@pytest.fixture
def compiled(monkeypatch):
    """Whatever numba's cache holds on the machine of the tests."""
    monkeypatch.setattr(warm, "is_compiled", lambda: True)


def test_the_first_flight_on_a_machine_says_why_it_waits(command_line, monkeypatch):
    monkeypatch.setattr(warm, "is_compiled", lambda: False)
    short = (*SHORT_LINE, "--no-picture", "--time-limit=1")
    _, _, err = command_line(*short)
    assert err.splitlines()[:2] == [run.COMPILING.format("kernels"), "Flying solo in farm, seed 5"]
    assert command_line(*short, "--quiet")[2] == ""


@pytest.mark.usefixtures("compiled")
def test_summary_on_stdout_progress_on_stderr_record_in_the_folder(command_line, tmp_path):
    code, out, err = command_line(*SHORT_LINE)
    assert code == 0
    assert out.startswith("SUCCESS: reached the goal\n")
    assert re.search("Run folder  runs/farm-5-001 .*flight.svg", out)
    assert err.startswith("Flying solo in farm, seed 5\n")
    assert "offboard" in err
    assert "\x1b" not in out + err
    names = {path.name for path in (tmp_path / "runs/farm-5-001").iterdir()}
    assert names == RECORD | {"flight.svg"}


def test_json_is_the_result_and_nothing_else(command_line, tmp_path):
    code, out, err = command_line(*SHORT_LINE, "--json", "--quiet", "--no-picture", "--out", "here")
    assert (code, err) == (0, "")
    assert json.loads(out) == load_run(tmp_path / "here/farm-5-001").result
    assert not (tmp_path / "here/farm-5-001/flight.svg").exists()


def test_another_outcome_than_the_expected_one_is_an_error(command_line):
    short = (*SHORT_LINE, "--quiet", "--no-picture", "--time-limit=1")
    code, out, err = command_line(*short, "--expect", "success")
    assert code == 1
    assert out.startswith("TIMEOUT")
    assert err.startswith("error: expected success, got TIMEOUT")
    assert len(err.splitlines()) == 1


def test_options_arrive_in_the_mission(command_line):
    code, out, err = command_line(
        *SHORT_LINE, "--json", "--quiet", "--no-picture", "--time-limit=1", "--planner=rrtconnect",
        "--vehicle=spark", "--v-max=2", "--land", "--expect=timeout",
    )  # fmt: skip
    assert (code, err) == (0, "")
    config = json.loads(out)["config"]
    expected = {
        "planner": "rrtconnect", "vehicle": "spark", "v_max_mps": 2.0, "time_limit_s": 1.0,
        "land": True, "seed": 5, "start": [2.0, 2.0, 0.0],
    }  # fmt: skip
    assert {name: config[name] for name in expected} == expected


MISSION = """
world = "farm"
seed = 5
start = [2.0, 2.0, 0.0]
goal = [10.0, 6.0, 5.0]
takeoff_height_m = 4.0
a_max_mps2 = 3.0
camera_columns = 32
time_limit_s = 9.0
[fault]
target = "command_vx"
at = "time=2"
persistence = "intermittent"
period_s = 0.5
[detector]
name = "aad"
alarms_max = 3
"""


def test_a_file_holds_a_whole_mission_and_options_replace_what_it_says(command_line, tmp_path):
    (tmp_path / "mission.toml").write_text(MISSION)
    fly = ("fly", "--config", "mission.toml", "--json", "--quiet", "--no-picture")
    _, out, err = command_line(*fly, "--time-limit=1.5", "--at=time=1", "--protect=control")
    assert err == ""
    config = json.loads(out)["config"]
    expected = {
        "world": "farm", "takeoff_height_m": 4.0, "a_max_mps2": 3.0, "camera_columns": 32,
        "time_limit_s": 1.5, "v_max_mps": 3.0,
    }  # fmt: skip
    assert {name: config[name] for name in expected} == expected
    fault, detector = config["fault"], config["detector"]
    assert (fault["target"], fault["at"], fault["period_s"]) == ("command_vx", "time=1", 0.5)
    assert (detector["name"], detector["alarms_max"]) == ("aad", 3)
    assert detector["protect"] == ["control"]


@pytest.mark.parametrize(
    ("text", "options", "code", "said"),
    [
        ("wrold = 3\n", (), 1, "mission.toml:1: wrold: .*'world'"),
        ("v_max_mps = 0\n", (), 1, "v_max_mps: .*0.1 and 12, got 0"),
        ("[fault]\nbits = 2\n", (), 1, "mission.toml"),
        ("", ("--v-max=0",), 2, "error: --v-max: .*0.1 and 12, got 0"),
        ("", ("--inject=planning", "--at=8"), 2, "time=8"),
    ],
)
def test_a_mistake_names_the_file_or_the_option(command_line, tmp_path, text, options, code, said):
    (tmp_path / "mission.toml").write_text(text)
    left, out, err = command_line("fly", "--config", "mission.toml", *options)
    assert (left, out, len(err.splitlines())) == (code, "", 1)
    assert re.search(said, err)


@pytest.mark.parametrize(("bit", "hinted"), [("0", True), ("62", False)])
def test_a_flip_that_is_too_small_to_see_names_one_that_shows(command_line, bit, hinted):
    line = [*SHORT_LINE, "--inject", "waypoint_yaw", "--bit", bit, "--no-picture", "--quiet"]
    code, out, _ = command_line(*line)
    assert code == 0
    last = out.splitlines()[-1]
    assert ("try: mavfi fly " in last) == hinted
    if hinted:
        words = shlex.split(last.partition("try: mavfi ")[2])
        assert words[:5] == ["fly", "--world", "farm", "--seed", "5"]
        assert words[5:9] == ["--start", "2.0,2.0,0.0", "--goal", "10.0,6.0,5.0"]
        assert words[-7:] == [
            "--inject", "waypoint_position", "--all-components", "--field", "exponent",
            "--fault-seed", "20",
        ]  # fmt: skip
        assert "waypoint_yaw" not in words
