r"""Flies a MAVSDK script through `mavfi gate` to PX4, kills the gate, and prints what PX4 does.

    PX4_SITL=/opt/px4/bin/px4 python benchmarks/gate_on_px4.py gate/gad.json --fail closed

Needs MAVSDK-Python. The script is `tests/clients/mavsdk_offboard.py`. 3 s after OFFBOARD begins,
the worker of the gate gets SIGKILL, and with `--both` its parent, too.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pymavlink import mavutil

SCRIPT = Path(__file__).parent.parent / "tests" / "clients" / "mavsdk_offboard.py"
PX4, COMPANION = "udpout:127.0.0.1:14600", "127.0.0.1:14541"
KILL_AFTER_S, LIMIT_S = 3.0, 120.0


def main() -> None:
    """Start vehicle, gate and script, and print the modes and texts of PX4 until it disarms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help="model of the gate's detector")
    parser.add_argument("--fail", choices=("open", "closed"), default="open")
    parser.add_argument("--both", action="store_true", help="kill the gate's parent, too")
    given = parser.parse_args()
    vehicle = ["sitl", "--hil", "px4", "--firmware", os.environ["PX4_SITL"], "--world", "farm"]
    gate = ["gate", "--autopilot", PX4, "--to", f"udpin:{COMPANION}", "--detector", "gad"]
    running: list[subprocess.Popen[bytes]] = []
    try:
        _start(running, ["mavfi", *vehicle, "--seed", "1"], "px4 is ready")
        _start(running, ["mavfi", *gate, "--model", given.model, "--fail", given.fail], "is ready")
        _start(running, [sys.executable, str(SCRIPT), f"udpout://{COMPANION}", "50071"], "")
        _watch(running[1].pid, both=given.both)
    finally:
        for process in reversed(running):
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10.0)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with the server of the script


def _start(running: list[subprocess.Popen[bytes]], command: list[str], ready: str) -> None:
    """Start a program, and wait until it has printed a text. Exit if it does not in time."""
    deadline_s = time.monotonic() + LIMIT_S
    with tempfile.NamedTemporaryFile() as said:
        running.append(subprocess.Popen(command, stdout=said, stderr=said, start_new_session=True))
        while ready not in Path(said.name).read_text():
            if running[-1].poll() is not None or time.monotonic() > deadline_s:
                sys.exit(Path(said.name).read_text())
            time.sleep(0.1)


def _watch(gate: int, *, both: bool) -> None:
    """Print what PX4 does, with the time since the first message, and kill the gate in OFFBOARD."""
    link = mavutil.mavlink_connection(PX4, source_system=250, source_component=190)
    begun_s = beat_s = time.monotonic()
    mode, offboard_s, killed = "", 0.0, False
    while (now_s := time.monotonic()) < begun_s + LIMIT_S:
        if now_s >= beat_s:
            link.mav.heartbeat_send(6, 8, 0, 0, 0)
            beat_s = now_s + 1.0
        message = link.recv_match(type=["HEARTBEAT", "STATUSTEXT"], blocking=True, timeout=0.2)
        if offboard_s and not killed and now_s >= offboard_s + KILL_AFTER_S:
            killed = True
            print(f"{now_s - begun_s:6.2f} s  the gate is killed")
            for child in _children(gate):
                os.kill(child, signal.SIGKILL)
            if both:
                os.kill(gate, signal.SIGKILL)
        if message is None or message.get_srcComponent() != 1:
            continue
        if message.get_type() == "STATUSTEXT":
            print(f"{now_s - begun_s:6.2f} s  {message.text}")
            continue
        armed = bool(message.base_mode & 128)
        if (new := mavutil.interpret_px4_mode(message.base_mode, message.custom_mode)) != mode:
            mode = new
            print(f"{now_s - begun_s:6.2f} s  {mode}")
            if mode == "OFFBOARD" and armed and not offboard_s:
                offboard_s = now_s
        if killed and not armed:
            return


def _children(process: int) -> list[int]:
    found = Path(f"/proc/{process}/task/{process}/children").read_text()
    return [int(child) for child in found.split()]


if __name__ == "__main__":
    main()
