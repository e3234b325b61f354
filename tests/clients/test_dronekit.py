"""DroneKit's last release against `python -m sitl` over TCP, with the script of its page."""

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest
from pages import block

from mavfi_cli import library
from mavfi_cli.spec.mission import FIRMWARE

needs_dronekit = pytest.mark.skipif(
    not (find_spec("dronekit") and find_spec("past")), reason="needs DroneKit"
)


@pytest.mark.slow
@needs_dronekit
def test_the_script_of_the_page_flies_and_lands(sitl, free_tcp_port, tmp_path):
    port = free_tcp_port()
    quiet = ("--camera-heartbeat", "0")
    server = sitl("--world", "farm", "--speed", "3", *quiet, "--link", f"tcpin:127.0.0.1:{port}")
    path = tmp_path / "fly.py"
    path.write_text(block("dronekit", "python"))
    done = subprocess.run(
        [sys.executable, str(path), f"tcp:127.0.0.1:{port}"],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, block("dronekit", "text")), done.stderr
    report, log = server.stop()
    assert report["collision"] is None
    assert log["velocity_enu_mps"][:, 1].max() == pytest.approx(2.0, abs=0.3)  # north
    assert not log["armed"][-1]


@pytest.mark.slow
@needs_dronekit
@pytest.mark.skipif(
    not os.environ.get(FIRMWARE["ardupilot"]), reason="no SITL binary of ArduCopter"
)
def test_the_script_of_ardupilot_s_page_flies_in_guided(tmp_path):
    (tmp_path / "guided.py").write_text(block("ardupilot", "python"))
    companion = tmp_path / "guided.toml"
    companion.write_text(block("ardupilot", "toml").replace("python ", f"{sys.executable} "))
    run = library.fly(
        companion=str(companion), autopilot="ardupilot", world="farm", time_limit_s=60.0,
        out=tmp_path,
    )  # fmt: skip
    assert (run.record.outcome, run.record.reason) == ("success", "fly ended with code 0")
    assert run.record.quality_of_flight.distance_m > 14.0
