import contextlib
import signal
import socket
import subprocess
import sys

import pytest

from mavfi_cli.link.codec import Codec, dialect

LONG_S = 60.0


class Companion:
    """A child `python -m sitl` in lockstep, and the companion's end of its socket."""

    def __init__(self, *arguments):
        ours, theirs = socket.socketpair()
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sitl", "--lockstep", "--fd", str(theirs.fileno()),
                 *arguments],
                pass_fds=[theirs.fileno()], stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
        ours.settimeout(LONG_S)
        self.socket = ours
        self.raw = b""
        self.messages = []
        self.stamp_ms = None
        self._codec = Codec(245, 190)
        self._decoder = Codec(245, 190)

    def receive_tick(self):
        """Everything up to the message that closes the tick; that message."""
        while True:
            data = self.socket.recv(1 << 16)
            assert data, f"sitl ended: {self.process.communicate(timeout=LONG_S)[1]}"
            self.raw += data
            found = self._decoder.decode(data)
            self.messages += found
            if found and found[-1].get_type() == "LOCAL_POSITION_NED":
                self.stamp_ms = found[-1].time_boot_ms
                return found[-1]

    def answer(self, *extra, **changes):
        """The messages `extra`, then the setpoint that lets the tick end."""
        fields = {
            "time_boot_ms": self.stamp_ms, "target_system": 1, "target_component": 1,
            "coordinate_frame": 1, "type_mask": 2503, "x": 0.0, "y": 0.0, "z": 0.0,
            "vx": 0.0, "vy": 0.0, "vz": 0.0, "afx": 0.0, "afy": 0.0, "afz": 0.0,
            "yaw": 0.0, "yaw_rate": 0.0, **changes,
        }  # fmt: skip
        setpoint = dialect.MAVLink_set_position_target_local_ned_message(**fields)
        frames = [self._codec.encode(message) for message in (*extra, setpoint)]
        self.socket.sendall(b"".join(frames))

    def fly(self, ticks, orders=None, setpoint=None):
        """Answer `ticks` ticks; `orders` {tick: [messages]}, `setpoint(tick)` -> fields."""
        for tick in range(ticks):
            self.receive_tick()
            extra = (orders or {}).get(tick, [])
            self.answer(*extra, **(setpoint(tick) if setpoint else {}))

    def take(self, kind):
        return [message for message in self.messages if message.get_type() == kind]

    def finish(self):
        """Hang up; exit code and stderr."""
        self.socket.close()
        _, errors = self.process.communicate(timeout=LONG_S)
        return self.process.returncode, errors

    def interrupt(self):
        self.process.send_signal(signal.SIGINT)

    def close(self):
        self.socket.close()
        self.process.kill()
        self.process.wait()
        self.process.stderr.close()


@pytest.fixture
def companion():
    with contextlib.ExitStack() as stack:

        def start(*arguments):
            started = Companion("--world", "farm", *arguments)
            stack.callback(started.close)
            return started

        yield start


def long_command(number, *parameters, component=1):
    nan = float("nan")
    given = [*parameters, *([nan] * (7 - len(parameters)))]
    return dialect.MAVLink_command_long_message(1, component, number, 0, *given)


@pytest.fixture
def order():
    return long_command


@pytest.fixture
def take_off():
    """Orders that arm and take off at 4.4 s and switch to OFFBOARD at 11 s."""
    return {
        220: [long_command(400, 1), long_command(22)],
        550: [long_command(176, 1, 6)],
    }
