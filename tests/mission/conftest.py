"""Processes of a mission: how to find them, kill them and await their end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from live_processes import LONG_S, children
from native_programs import native_program  # noqa: F401

from mavfi_cli.mission.progress import Watcher


def command_line(pid):
    return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")


def vehicle_of(pid):
    """The `python -m sitl` that a mission has started."""
    (found,) = [child for child in children(pid) if b"sitl" in command_line(child)]
    return found


class AtEvent(Watcher):
    """Does something once, as soon as the flight tells an event of this text."""

    def __init__(self, text, action):
        self._text, self._action = text, action
        self.events = []

    def on_event(self, event):
        self.events.append(event)
        if event.text == self._text and self._action is not None:
            action, self._action = self._action, None
            action()


@pytest.fixture
def at_event():
    return AtEvent


@pytest.fixture
def kill_vehicle():
    """Kill this process's own simulated vehicle."""
    return lambda: os.kill(vehicle_of(os.getpid()), signal.SIGKILL)


class FlyingProcess:
    """`mavfi fly` in a process of its own, with its plain progress lines on stderr."""

    def __init__(self, folder, *arguments):
        self.out = Path(folder) / "runs"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mavfi_cli", "fly", "--out", str(self.out), *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
        )  # fmt: skip

    def await_line(self, text):
        for line in self.process.stderr:
            if text in line:
                return
        raise AssertionError(f"the mission ended before it said {text!r}")

    @contextlib.contextmanager
    def vehicle_descriptor(self):
        descriptor = os.pidfd_open(vehicle_of(self.process.pid))
        try:
            yield descriptor
        finally:
            os.close(descriptor)

    def end(self):
        """Await the end; exit code, stdout, what was left of stderr, and the one run folder."""
        out, err = self.process.communicate(timeout=LONG_S)
        (folder,) = self.out.iterdir()
        return self.process.returncode, out, err, folder

    def close(self):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()
        self.process.stderr.close()


@pytest.fixture
def flying(tmp_path):
    """Starts `mavfi fly` on a way of 80 m, and leaves no process behind."""
    with contextlib.ExitStack() as stack:

        def start(*arguments):
            place = ("--world", "farm", "--start=2,2,0", "--goal=58,58,5")
            started = FlyingProcess(tmp_path, *place, *arguments)
            stack.callback(started.close)
            return started

        yield start


@pytest.fixture
def sitl_on_udp(start_sitl):
    """The URL of a simulated vehicle that runs for one test."""
    with start_sitl() as url:
        yield url
