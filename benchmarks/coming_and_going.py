"""Checks that the memory of `mavfi sitl` stays flat while clients come and go for two hours.

    python benchmarks/coming_and_going.py --hours 2 --speed 20

The hours are simulated. Up to 8 clients at a time connect over TCP or UDP, request parameters, a
fast stream or the camera, take off or land, and leave after a few seconds. Some of them never read
what the server sends. The command prints the memory of the server every ten simulated minutes, and
exits with 1 if it grows by more than 5 % after the first tenth of the time.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import random
import socket
import sys
import time

from hostile_frames import Observer, Server, running_server

from mavfi_cli.link.codec import Codec, Message, dialect

_CLIENTS = 8
_STAY_S = (0.2, 4.0)
_REPORT_S = 600.0


def _order(component: int, number: int, *parameters: float) -> Message:
    given = [*parameters, *([math.nan] * (7 - len(parameters)))]
    return dialect.MAVLink_command_long_message(1, component, number, 0, *given)


_ORDERS = (
    dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3),
    dialect.MAVLink_param_request_list_message(1, 1),
    dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_CRUISE", 4.0, 9),
    dialect.MAVLink_statustext_message(6, b"here I am"),
    _order(1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAVLINK_MSG_ID_ATTITUDE, 4000.0),
    _order(100, dialect.MAV_CMD_IMAGE_START_CAPTURE, 0.0, 0.1, 0.0),
    _order(1, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0),
    _order(1, dialect.MAV_CMD_NAV_TAKEOFF),
    _order(1, dialect.MAV_CMD_NAV_LAND),
    _order(1, dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0),
)


class _Visitor:
    """A client that sends a few requests and leaves."""

    def __init__(self, server: Server, rng: random.Random) -> None:
        over_tcp = rng.random() < 0.5
        kind, port = (
            (socket.SOCK_STREAM, server.tcp) if over_tcp else (socket.SOCK_DGRAM, server.udp)
        )
        self._socket = socket.socket(socket.AF_INET, kind)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(0.0)
        self._codec = Codec(rng.randrange(1, 256), 190)
        self._reads = rng.random() < 0.8
        self._rng = rng
        self.leaves_s = time.monotonic() + rng.uniform(*_STAY_S)

    def act(self) -> None:
        """Send a random request now and then, and read all waiting bytes if this client reads."""
        with contextlib.suppress(OSError):
            if self._rng.random() < 0.2:
                self._socket.send(self._codec.encode(self._rng.choice(_ORDERS)))
            while self._reads and self._socket.recv(1 << 16):
                pass

    def leave(self) -> None:
        """Close the connection."""
        self._socket.close()


def soak(hours: float, speed: float) -> float:
    """Return by what share the server's memory grows after the first tenth of the time."""
    rng = random.Random(1)
    visitors: list[_Visitor] = []
    with running_server("--speed", f"{speed:g}") as server:
        observer = Observer(server.tcp, signed=False)
        end_s, told_s, warm_mb = hours * 3600.0, 0.0, 0.0
        came = 0
        while observer.simulated_s < end_s and server.process.poll() is None:
            observer.listen()
            if len(visitors) < _CLIENTS and rng.random() < 0.3:
                visitors.append(_Visitor(server, rng))
                came += 1
            for visitor in list(visitors):
                visitor.act()
                if time.monotonic() > visitor.leaves_s:
                    visitor.leave()
                    visitors.remove(visitor)
            if not warm_mb and observer.simulated_s > 0.1 * end_s:
                warm_mb = server.resident_mb()
            if observer.simulated_s >= told_s:
                told_s += _REPORT_S
                print(f"{observer.simulated_s:6.0f} s  {server.resident_mb():.1f} MB  "
                      f"{came} clients came", flush=True)  # fmt: skip
            time.sleep(0.02)
        growth = server.resident_mb() / warm_mb - 1.0
        for visitor in visitors:
            visitor.leave()
        observer.close()
    return growth


def main() -> None:
    """Run the clients, report the growth of the memory, and exit with 1 if it is too large."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--speed", type=float, default=20.0)
    given = parser.parse_args()
    growth = soak(given.hours, given.speed)
    print(f"memory {growth:+.1%} after the first tenth")
    sys.exit(1 if growth > 0.05 else 0)


if __name__ == "__main__":
    main()
