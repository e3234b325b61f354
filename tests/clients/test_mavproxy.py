"""MAVProxy, unchanged, against `python -m sitl` over TCP and as a companion, through its prompt."""

import contextlib
import importlib.util
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from pages import block

from mavfi_cli import library
from mavfi_cli.spec.mission import FIRMWARE

_MODULES = "param,arm,mode,cmdlong,misc"


class MavProxy:
    """The MAVProxy process: commands in, and waiting for what it prints."""

    def __init__(self, port, folder):
        script = Path(importlib.util.find_spec("MAVProxy").origin).with_name("mavproxy.py")
        self.process = subprocess.Popen(
            [
                sys.executable, str(script), f"--master=tcp:127.0.0.1:{port}",
                f"--state-basedir={folder}", f"--default-modules={_MODULES}",
            ],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder,
            start_new_session=True,
        )  # fmt: skip
        self._pieces = queue.Queue()
        self._text = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        while piece := self.process.stdout.read1(4096):
            self._pieces.put(piece.decode(errors="replace"))
        self._pieces.put(None)

    def command(self, line):
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def expect_mode(self, mode):
        """Its prompt shows the mode of the newest HEARTBEAT."""
        self.expect(rf"{mode}> ")

    def expect(self, pattern, timeout_s=40.0):
        """Wait for a pattern in what it prints; what came before it is used up."""
        deadline = time.monotonic() + timeout_s
        while (match := re.search(pattern, self._text)) is None:
            try:
                piece = self._pieces.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                piece = None
            assert piece is not None, f"no {pattern!r} in:\n{self._text}"
            self._text += piece
        self._text = self._text[match.end() :]
        return match

    def close(self):
        with contextlib.suppress(OSError):
            self.command("exit")
            self.process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(10)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)  # modules leave processes of their own
        self.process.wait()
        self._reader.join()
        self.process.stdout.close()


def shown(proxy, name):
    proxy.command(f"param show {name}")
    return float(proxy.expect(rf"{name}\s+([\d.]+)").group(1))


def await_shown(proxy, name, value, timeout_s=40.0):
    """MAVProxy shows the old value until the vehicle has confirmed the new one."""
    deadline = time.monotonic() + timeout_s
    while shown(proxy, name) != value:
        assert time.monotonic() < deadline, f"{name} is not {value}"
        time.sleep(0.1)


@pytest.fixture
def connect(tmp_path):
    with contextlib.ExitStack() as stack:

        def start(port):
            proxy = MavProxy(port, tmp_path)
            stack.callback(proxy.close)
            return proxy

        yield start


@pytest.mark.slow
def test_mavproxy_sets_parameter_and_mode_arms_takes_off_and_lands(sitl, connect, free_tcp_port):
    port = free_tcp_port()
    server = sitl("--world", "farm", "--speed", "5", "--link", f"tcpin:127.0.0.1:{port}")
    proxy = connect(port)

    proxy.expect(r"Mode LOITER")
    proxy.expect(r"Received \d+ parameters")
    assert shown(proxy, "MIS_TAKEOFF_ALT") == 2.5
    proxy.command("param set MIS_TAKEOFF_ALT 3.5")
    await_shown(proxy, "MIS_TAKEOFF_ALT", 3.5)

    proxy.command("long DO_SET_MODE 1 3 0 0 0 0 0")
    proxy.expect_mode("POSCTL")
    proxy.command("long DO_SET_MODE 1 4 3 0 0 0 0")
    proxy.expect_mode("LOITER")
    proxy.command("arm throttle")
    proxy.expect(r"ARMED")
    proxy.command("long NAV_TAKEOFF 0 0 0 nan nan nan nan")
    proxy.expect(r"Using default takeoff altitude: 3.5 m")
    proxy.expect_mode("TAKEOFF")
    proxy.expect_mode("LOITER")
    proxy.command("long NAV_LAND")
    proxy.expect_mode("LAND")
    proxy.expect(r"Disarmed by landing")
    proxy.expect(r"DISARMED")

    report, log = server.stop()
    assert report["collision"] is None
    assert log["position_enu_m"][:, 2].max() == pytest.approx(3.6, abs=0.3)
    assert log["on_ground"][-1]
    assert not log["armed"][-1]


@pytest.mark.slow
def test_mavproxy_hears_why_offboard_cannot_arm(sitl, connect, free_tcp_port):
    port = free_tcp_port()
    server = sitl("--world", "farm", "--speed", "5", "--link", f"tcpin:127.0.0.1:{port}")
    proxy = connect(port)
    proxy.expect(r"Received \d+ parameters")
    proxy.command("long DO_SET_MODE 1 6 0 0 0 0 0")
    proxy.expect_mode("OFFBOARD")
    proxy.command("arm throttle")
    proxy.expect(r"COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED")
    proxy.expect(r"Arming denied: Resolve system health failures first")
    _, log = server.stop()
    assert not log["armed"].any()


@pytest.mark.slow
def test_the_lines_of_the_page_do_what_it_says(sitl, connect, free_tcp_port):
    """Each is typed when the one before has taken effect."""
    port = free_tcp_port()
    link = ("--link", f"tcpin:127.0.0.1:{port}", "--camera-heartbeat", "0")
    server = sitl("--world", "farm", "--speed", "5", *link)
    proxy = connect(port)
    proxy.expect(r"Received \d+ parameters")
    answers = [
        r"MPC_XY_CRUISE\s+5\.0\s+MPC_XY_VEL_MAX\s+12\.0", r"", r"Loaded module wp",
        r"Available modes: .*POSCTL.*OFFBOARD", r"POSCTL> ", r"ATTITUDE \{time_boot_ms : \d+",
        r"LOITER> ", r"ARMED", r"TAKEOFF> (?s:.*)LOITER> ", r"Disarmed by landing",
    ]  # fmt: skip
    for line, answer in zip(block("mavproxy", "text").splitlines(), answers, strict=True):
        proxy.command(line)
        proxy.expect(answer)
    _, log = server.stop()
    assert log["position_enu_m"][:, 2].max() == pytest.approx(3.6, abs=0.3)


@pytest.mark.slow
def test_mavproxy_loads_its_modules_and_fetches_parameters_again(sitl, connect, free_tcp_port):
    port = free_tcp_port()
    server = sitl("--world", "farm", "--speed", "5", "--link", f"tcpin:127.0.0.1:{port}")
    proxy = connect(port)
    proxy.expect(r"Received \d+ parameters")
    for module in ("graph", "link", "terrain"):
        proxy.command(f"module load {module}")
        proxy.expect(rf"Loaded module {module}|module {module} already loaded")
    proxy.command("module list")
    proxy.expect(r"graph: ")
    proxy.command("param set MPC_XY_VEL_MAX 4")
    await_shown(proxy, "MPC_XY_VEL_MAX", 4.0)
    proxy.command("param fetch")
    proxy.expect(r"Received \d+ parameters")
    assert shown(proxy, "MPC_XY_VEL_MAX") == 4.0
    server.stop()


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["ours", "ardupilot"])
def test_mavproxy_flies_as_a_companion(tmp_path, autopilot):
    if autopilot in FIRMWARE and not os.environ.get(FIRMWARE[autopilot]):
        pytest.skip(f"{FIRMWARE[autopilot]} names no SITL binary of {autopilot}")
    script = Path(__file__).with_name("mavproxy_flight.py")
    kind = "px4" if autopilot == "ours" else autopilot
    companion = tmp_path / "mavproxy.toml"
    companion.write_text(
        "camera_heartbeat = false\n"
        f"[program.fly]\ncommand = '{sys.executable} {script} {{link}} {kind}'\n"
    )
    run = library.fly(
        companion=str(companion), autopilot=autopilot, world="farm", time_limit_s=60.0,
        out=tmp_path,
    )  # fmt: skip
    assert (run.record.outcome, run.record.reason) == ("success", "fly ended with code 0")
    assert run.record.quality_of_flight.distance_m > 14.0
