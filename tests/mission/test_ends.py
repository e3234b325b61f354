"""Missions that end badly leave a record that says so, and no process behind."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from live_processes import LONG_S, await_end, family, gone
from missions import RECORD

from mavfi_cli.autonomy import collision
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.mission.vehicle import VehicleProcess

MAVLOGDUMP = Path(sys.executable).parent / "mavlogdump.py"


def dumped(tlog):
    """Message types in a tlog, as the real mavlogdump.py reads them."""
    done = subprocess.run(
        [sys.executable, str(MAVLOGDUMP), "--format", "json", str(tlog)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return [line["meta"]["type"] for line in lines]


def test_mavlogdump_reads_the_whole_flight(short_flight):
    kinds = dumped(short_flight.tlog)
    result = load_run(short_flight.path).result
    ticks = round(result["simulated_s"] / 0.02) + 1
    assert kinds.count("LOCAL_POSITION_NED") == ticks
    assert kinds.count("SET_POSITION_TARGET_LOCAL_NED") == ticks
    assert {"HEARTBEAT", "COMMAND_LONG", "COMMAND_ACK", "ENCAPSULATED_DATA"} <= set(kinds)
    assert "BAD_DATA" not in kinds


@pytest.mark.parametrize("text", ["waiting until ready", "taking off", "flies a plan"])
def test_interrupted_by_ctrl_c_the_record_is_whole(fly_short, at_event, text):
    watcher = at_event(text, lambda: signal.raise_signal(signal.SIGINT))
    run = load_run(fly_short(watcher).path)
    assert run.result["outcome"] == "interrupted"
    assert run.result["referee"] is not None
    assert (run.trace.num_rows > 0) == (text == "flies a plan")
    assert watcher.events[-1].text == "interrupted"


@pytest.mark.slow
def test_ctrl_c_on_the_command_line_exits_with_130(flying):
    mission = flying()
    mission.await_line("flies a plan")
    mission.process.send_signal(signal.SIGINT)
    code, out, _, folder = mission.end()
    assert code == 130
    assert out.startswith("INTERRUPTED\n")
    assert load_run(folder).result["outcome"] == "interrupted"
    assert {path.name for path in folder.iterdir()} == RECORD | {"flight.svg"}


def test_a_killed_mission_by_the_wall_clock_leaves_no_vehicle(flying):
    mission = flying("--realtime")
    mission.await_line("waiting until ready")
    with mission.vehicle_descriptor() as vehicle:
        mission.process.kill()
        mission.process.wait()
        await_end(vehicle)


def test_a_killed_mission_leaves_no_vehicle_and_no_firmware_that_boots(flying, tmp_path):
    firmware = tmp_path / "arducopter"
    firmware.write_text("#!/bin/sh\nexec sleep 600\n")
    firmware.chmod(0o755)
    mission = flying("--realtime", "--autopilot", "ardupilot", "--firmware", str(firmware))
    until_s = time.monotonic() + LONG_S
    processes = []
    while not (processes and Path(f"/proc/{processes[-1]}/comm").read_text() == "sleep\n"):
        assert time.monotonic() < until_s
        processes = family(mission.process.pid)[1:]
    mission.process.kill()
    mission.process.wait()
    killed_s = time.monotonic()
    assert all(map(gone, processes))
    assert time.monotonic() - killed_s < 5.0  # before the vehicle gives up on the firmware


@pytest.mark.slow
def test_a_killed_mission_leaves_its_tlog(flying, mavfi):
    mission = flying()
    mission.await_line("flies a plan")
    mission.process.kill()
    code, _, _, folder = mission.end()
    assert code == -signal.SIGKILL
    assert {path.name for path in folder.iterdir()} == {"flight.tlog"}
    assert dumped(folder / "flight.tlog").count("LOCAL_POSITION_NED") > 400
    shown = mavfi("show", folder)
    assert shown.returncode == 1
    assert shown.stderr.startswith(f"error: {folder}: result.json is missing ")
    assert len(shown.stderr.splitlines()) == 1


def test_a_vehicle_that_is_killed_is_a_lost_link(fly_short, at_event, kill_vehicle, short_flight):
    folder = fly_short(at_event("flies a plan", kill_vehicle), launch=VehicleProcess)
    run = load_run(folder.path)
    assert run.result["outcome"] == "link_lost"
    assert "SIGKILL" in run.result["reason"]
    assert run.result["referee"] is None
    assert run.trace.num_rows > 0
    assert "truth_x_m" not in run.trace.column_names
    assert "BAD_DATA" not in dumped(folder.tlog)
    parting = load_run(short_flight.path).first_difference(run, truth=True)
    assert (parting.column, parting.other) == ("outcome", "link_lost")


def test_an_error_in_a_kernel_is_a_crash_with_its_traceback(fly_short, monkeypatch):
    real, calls = collision.step, []

    def breaks_later(*arguments):
        calls.append(1)
        if len(calls) > 5:
            raise IndexError("no such voxel \udc80")
        return real(*arguments)

    monkeypatch.setattr(collision, "step", breaks_later)
    folder = fly_short()
    result = load_run(folder.path).result
    assert result["outcome"] == "crash"
    assert result["reason"] == r"IndexError: no such voxel \udc80"
    assert "Traceback" in (folder.path / "crash.txt").read_text(encoding="utf-8")
