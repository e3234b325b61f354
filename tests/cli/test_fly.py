"""`mavfi fly`: what it prints, and with which code it leaves."""

import json

import pytest

from mavfi_cli.mission import sortie
from mavfi_cli.mission.record.run_folder import load_run

SHORT = ("fly", "--world", "farm", "--seed=5", "--start=2,2,0", "--goal=10,6,5")


@pytest.fixture
def compiled(monkeypatch):
    """Whatever numba's cache holds on the machine of the tests."""
    monkeypatch.setattr(sortie, "is_compiled", lambda: True)


def test_the_first_flight_on_a_machine_says_why_it_waits(command_line, monkeypatch):
    monkeypatch.setattr(sortie, "is_compiled", lambda: False)
    short = (*SHORT, "--no-picture", "--time-limit=1")
    _, _, err = command_line(*short)
    assert err.splitlines()[:2] == [sortie.COMPILING, "Flying solo in farm, seed 5"]
    assert command_line(*short, "--quiet")[2] == ""


@pytest.mark.usefixtures("compiled")
def test_summary_on_stdout_progress_on_stderr_record_in_the_folder(command_line, tmp_path):
    code, out, err = command_line(*SHORT)
    assert code == 0
    assert out.startswith("SUCCESS: reached the goal\n")
    assert "Run folder  runs/farm-5-001  (see flight.svg)" in out
    assert err.startswith("Flying solo in farm, seed 5\n")
    assert "offboard" in err
    assert "\x1b" not in out + err
    names = {path.name for path in (tmp_path / "runs/farm-5-001").iterdir()}
    assert names == {
        "result.json",
        "trace.parquet",
        "plans.parquet",
        "kernels.parquet",
        "flight.tlog",
        "flight.svg",
    }


def test_json_is_the_result_and_nothing_else(command_line, tmp_path):
    code, out, err = command_line(*SHORT, "--json", "--quiet", "--no-picture", "--out", "here")
    assert (code, err) == (0, "")
    assert json.loads(out) == load_run(tmp_path / "here/farm-5-001").result
    assert not (tmp_path / "here/farm-5-001/flight.svg").exists()


def test_expect(command_line):
    short = (*SHORT, "--quiet", "--no-picture", "--time-limit=1")
    code, _, err = command_line(*short, "--expect", "timeout")
    assert (code, err) == (0, "")
    code, out, err = command_line(*short, "--expect", "success")
    assert code == 1
    assert out.startswith("TIMEOUT")
    assert err.startswith("error: expected success, got TIMEOUT")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("planner", ["rrt", "rrtconnect"])
def test_options_arrive_in_the_mission(command_line, planner):
    _, out, _ = command_line(
        *SHORT, "--json", "--quiet", "--no-picture", "--time-limit=1", "--planner", planner,
        "--vehicle=spark", "--v-max=2", "--a-max=3", "--tolerance=2", "--camera=32x24",
        "--height=4", "--land",
    )  # fmt: skip
    config = json.loads(out)["config"]
    expected = {
        "planner": planner, "vehicle": "spark", "v_max_mps": 2.0, "a_max_mps2": 3.0,
        "goal_tolerance_m": 2.0, "camera_columns": 32, "camera_rows": 24, "time_limit_s": 1.0,
        "takeoff_height_m": 4.0, "land": True, "seed": 5, "start": [2.0, 2.0, 0.0],
    }  # fmt: skip
    assert {name: config[name] for name in expected} == expected
