import contextlib
import json
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

READY = "Ctrl-C ends it."


class RunningSitl:
    """`python -m sitl` in the background, with the truth that it leaves behind."""

    def __init__(self, arguments, folder):
        self._folder = Path(folder)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sitl", "--truth", str(folder), *arguments],
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said = []
        for line in self.process.stderr:
            self.said.append(line.rstrip("\n"))
            if READY in line:
                return
        raise AssertionError(f"sitl ended early: {self.said}")

    def stop(self):
        """End it as Ctrl-C does; the referee's report and log."""
        self.process.send_signal(signal.SIGINT)
        _, errors = self.process.communicate(timeout=30)
        assert (self.process.returncode, errors) == (0, "")
        report = json.loads((self._folder / "truth.json").read_text())
        with np.load(self._folder / "truth.npz") as log:
            return report, {name: log[name] for name in log.files}


def _free_port(kind):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def free_udp_port():
    return lambda: _free_port(socket.SOCK_DGRAM)


@pytest.fixture
def free_tcp_port():
    return lambda: _free_port(socket.SOCK_STREAM)


@pytest.fixture
def sitl(tmp_path):
    """Starts servers and leaves none behind."""
    with contextlib.ExitStack() as stack:

        def start(*arguments):
            server = RunningSitl(arguments, tmp_path / "truth")
            stack.callback(server.process.stderr.close)
            stack.callback(server.process.wait)
            stack.callback(server.process.kill)
            return server

        yield start
