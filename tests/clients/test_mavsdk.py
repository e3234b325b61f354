"""MAVSDK-Python, unchanged, against `python -m sitl` over loopback UDP."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from pages import block

SCRIPT = Path(__file__).with_name("mavsdk_flight.py")


@pytest.mark.slow
def test_mavsdk_arms_takes_off_flies_offboard_and_lands(sitl, free_udp_port, free_tcp_port):
    port = free_udp_port()
    server = sitl("--world", "farm", "--speed", "5", "--link", f"udpout:127.0.0.1:{port}")
    client = subprocess.run(
        [sys.executable, str(SCRIPT), f"udpin://127.0.0.1:{port}", str(free_tcp_port())],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert client.returncode == 0, client.stderr
    seen = json.loads(client.stdout)
    report, log = server.stop()

    assert all(seen["health"].values()), seen["health"]
    assert seen["all_ok"]
    assert seen["version"] == [1, 17]
    assert seen["takeoff_altitude"] == 4.0
    assert seen["parameter"] == 3
    assert seen["parameters"] > 40
    assert seen["armed"]
    assert seen["longest_range"] == 25.0
    assert seen["disarmed"]
    assert seen["mode_offboard"] == "OFFBOARD"
    assert seen["mode_after"] == "HOLD"
    # What MAVSDK was told is what really happened.
    assert report["collision"] is None
    assert log["position_enu_m"][:, 2].max() == pytest.approx(4.1, abs=0.4)
    speeds = log["velocity_enu_mps"]
    assert speeds[:, 1].max() == pytest.approx(2.0, abs=0.3)  # north
    assert log["armed"].any()
    assert not log["armed"][-1]
    assert log["on_ground"][-1]


@pytest.mark.slow
def test_mavsdk_flies_attitudes(sitl, free_udp_port, free_tcp_port):
    port = free_udp_port()
    server = sitl("--world", "farm", "--link", f"udpout:127.0.0.1:{port}")
    script = SCRIPT.with_name("mavsdk_attitude.py")
    client = subprocess.run(
        [sys.executable, str(script), f"udpin://127.0.0.1:{port}", str(free_tcp_port())],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert client.returncode == 0, client.stderr
    report, log = server.stop()
    assert report["collision"] is None
    assert log["position_enu_m"][:, 2].max() > 2.0
    east = log["velocity_enu_mps"][:, 0]  # the vehicle faces north, so a roll to the right
    assert east.max() > 2.0
    assert log["on_ground"][-1]


@pytest.mark.slow
def test_the_script_of_the_page_flies_and_lands(sitl, free_udp_port, free_tcp_port, tmp_path):
    """As it is printed, but for the port on which MAVSDK's own server listens."""
    port = free_udp_port()
    server = sitl("--world", "farm", "--speed", "5", "--link", f"udpout:127.0.0.1:{port}")
    script = block("mavsdk", "python")
    assert script.count("System()") == 1
    path = tmp_path / "fly.py"
    path.write_text(script.replace("System()", f"System(port={free_tcp_port()})"))
    done = subprocess.run(
        [sys.executable, str(path), f"udpin://127.0.0.1:{port}"],
        capture_output=True, text=True, timeout=180, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, block("mavsdk", "text")), done.stderr
    report, log = server.stop()
    assert report["collision"] is None
    assert not log["armed"][-1]
