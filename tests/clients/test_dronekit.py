"""DroneKit's last release against `python -m sitl` over TCP, with the script of its page."""

import subprocess
import sys
from importlib.util import find_spec

import pytest
from pages import block


@pytest.mark.slow
@pytest.mark.skipif(not (find_spec("dronekit") and find_spec("past")), reason="needs DroneKit")
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
