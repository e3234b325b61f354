"""Floods `mavfi sitl` with valid frames from many UDP ports, and counts its reply to one frame.

    python benchmarks/hostile_ports.py

First 70 ports send frames with a correct checksum at a given rate, and an observer with a TCP link
measures the clock of the server. In one flood the frames are of any message, in the other they
request streams of 250 Hz. Then one HEARTBEAT comes from a port that stays silent, as if its address
were forged, and the bytes that the server sends there are counted. The command exits with 1 if the
clock runs at less than half of real time, or if the server answers the HEARTBEAT with more than
32 kB. The clock depends on the load of the machine, which is printed.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import socket
import sys
import time

from hostile_frames import Observer, message_request, running_server, valid_frame

from mavfi_cli.link.codec import Codec, dialect

_POOL = 3000
_STREAMS = (24, 30, 31, 32, 33, 36, 74, 83, 85, 105)  # message ids
_INTERVAL_US = 4000
_LEAST_CLOCK, _MOST_BYTES = 0.5, 32_000


def _stream_request(rng: random.Random) -> bytes:
    command = (1, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, rng.choice(_STREAMS), _INTERVAL_US)
    message = dialect.MAVLink_command_long_message(*command, 0, 0, 0, 0, 0)
    return Codec(rng.randrange(1, 255), 190).encode(message)


def _udp(port: int) -> socket.socket:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect(("127.0.0.1", port))
    client.settimeout(0.0)
    return client


def clock_under_flood(
    kind: str, ports: int, rate_hz: float, duration_s: float
) -> tuple[float, float]:
    """Return the simulated seconds per second under a flood, and the frames sent per second."""
    rng = random.Random(1)
    frame = valid_frame if kind == "any message" else _stream_request
    pool = [frame(rng) for _ in range(_POOL)]
    with running_server() as server, contextlib.ExitStack() as stack:
        observer = stack.enter_context(contextlib.closing(Observer(server.tcp, signed=False)))
        observer.ask("HOME_POSITION", message_request(dialect.MAVLINK_MSG_ID_HOME_POSITION))
        clients = [stack.enter_context(_udp(server.udp)) for _ in range(ports)]
        simulated_s, begun_s, sent = observer.simulated_s, time.monotonic(), 0
        while (passed_s := time.monotonic() - begun_s) < duration_s:
            while sent < rate_hz * passed_s:
                sent += 1
                with contextlib.suppress(OSError):
                    rng.choice(clients).send(rng.choice(pool))
            for client in clients:
                with contextlib.suppress(OSError):
                    client.recv(1 << 16)
            observer.listen()
            time.sleep(0.001)
        return (observer.simulated_s - simulated_s) / passed_s, sent / passed_s


def reply_to_one_heartbeat(duration_s: float) -> tuple[int, int]:
    """Return the length of a HEARTBEAT, and of everything the server sends after it, in bytes."""
    frame = Codec(245, 190).encode(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    with running_server() as server, _udp(server.udp) as client:
        client.send(frame)
        client.settimeout(0.5)
        received, until_s = 0, time.monotonic() + duration_s
        while time.monotonic() < until_s:
            with contextlib.suppress(TimeoutError):
                received += len(client.recv(1 << 16))
    return len(frame), received


def main() -> None:
    """Measure the floods and the reply, and report. Exit with 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ports", type=int, default=70)
    parser.add_argument("--rate", type=float, default=5400.0, help="frames a second")
    parser.add_argument("--seconds", type=float, default=12.0, help="duration of a flood")
    parser.add_argument("--silence", type=float, default=35.0, help="time to count replies, s")
    given = parser.parse_args()
    clocks = []
    for kind in ("any message", "stream requests"):
        clock, rate_hz = clock_under_flood(kind, given.ports, given.rate, given.seconds)
        clocks.append(clock)
        print(
            f"{kind}: {rate_hz:.0f} frames a second from {given.ports} ports, "
            f"clock {clock:.2f} of real time, load {os.getloadavg()[0]:.1f}",
            flush=True,
        )
    sent, received = reply_to_one_heartbeat(given.silence)
    print(f"one HEARTBEAT of {sent} bytes: {received} bytes in {given.silence:g} s")
    sys.exit(1 if min(clocks) < _LEAST_CLOCK or received > _MOST_BYTES else 0)


if __name__ == "__main__":
    main()
