"""Measures the time that `mavfi gate` adds to a setpoint, over UDP on this machine.

    python benchmarks/gate_latency.py --model gate/gad.json --setpoints 5000

A socket of a companion sends setpoints 5 ms apart, and a socket of an autopilot sends a state
before each setpoint. The same datagram is also timed when sent directly between the two sockets.
Both times and their difference are printed.
"""

from __future__ import annotations

import argparse
import socket
import subprocess
import sys
import time

import numpy as np

from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.router import Side
from mavfi_cli.mission.setpoint_gate import SetpointGate
from mavfi_cli.spec.companion import GateConfig
from mavfi_cli.spec.detector import DetectorConfig

_MASK = 0b1101_1100_0111
PAUSE_S = 0.005


def _socket() -> socket.socket:
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.bind(("127.0.0.1", 0))
    end.settimeout(10.0)
    return end


def _setpoint(codec: Codec, stamp_ms: int) -> bytes:
    return codec.encode(
        dialect.MAVLink_set_position_target_local_ned_message(
            stamp_ms, 1, 1, 1, _MASK, 0, 0, 0, 2.0, 0, 0, 0, 0, 0, 0, 0
        )
    )


def _states(codec: Codec, stamp_ms: int) -> list[bytes]:
    return [
        codec.encode(dialect.MAVLink_attitude_message(stamp_ms, 0, 0, 0, 0, 0, 0)),
        codec.encode(dialect.MAVLink_local_position_ned_message(stamp_ms, 1, 0, -5, 2, 0, 0)),
    ]


def _compute(detector: str, model: str, count: int) -> None:
    """Print the processor time of reading and judging a setpoint, without sockets."""
    gate = SetpointGate(
        DetectorConfig(name=detector, model=model), GateConfig(watch_only=True), None, note=print
    )
    own, other, receiver, times = Codec(1, 191), Codec(1, 1), Codec(0, 0), []
    for number in range(count + 200):
        for frame in _states(other, 20 * number):
            for message in receiver.decode(frame):
                gate.pass_between(message, Side.AUTOPILOT, 0.02 * number)
        frame = _setpoint(own, number)
        begun_ns = time.process_time_ns()
        for message in receiver.decode(frame):
            gate.pass_between(message, Side.COMPANION, 0.02 * number)
        times.append((time.process_time_ns() - begun_ns) / 1e6)
    p50, p99 = np.percentile(times[200:], [50, 99])
    print(f"{'processor time':<17} {p50:.3f} ms median, {p99:.3f} ms p99, n = {count}")


def main() -> None:
    """Measure the times, and print their medians and 99th percentiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", required=True)
    parser.add_argument("--detector", default="gad")
    parser.add_argument("--setpoints", type=int, default=5000)
    options = parser.parse_args()
    autopilot, companion = _socket(), _socket()
    url = f"udpout:127.0.0.1:{autopilot.getsockname()[1]}"
    line = [sys.executable, "-m", "mavfi_cli", "gate", "--autopilot", url]
    line += ["--to", "udpin:127.0.0.1:0", "--detector", options.detector]
    process = subprocess.Popen(
        [*line, "--model", options.model, "--watch-only"], stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        ready = process.stderr.readline()
        gate = ("127.0.0.1", int(ready.split()[-1]))
        direct = autopilot.getsockname()
        own, other = Codec(1, 191), Codec(1, 1)
        through, straight = [], []
        address = None
        for number in range(options.setpoints + 100):
            if address is not None:
                for frame in _states(other, 20 * number):
                    autopilot.sendto(frame, address)
            time.sleep(PAUSE_S)
            for place, times in ((gate, through), (direct, straight)):
                frame = _setpoint(own, number)
                begun_s = time.perf_counter()
                companion.sendto(frame, place)
                data = b""
                while data != frame:  # the gate's own texts come in between
                    data, sender = autopilot.recvfrom(1000)
                times.append(time.perf_counter() - begun_s)
                address = sender if place is gate else address
    finally:
        process.terminate()
        process.wait()
    for name, times in (("through the gate", through), ("direct", straight)):
        p50, p99 = 1e3 * np.percentile(times[100:], [50, 99])
        print(f"{name:<17} {p50:.3f} ms median, {p99:.3f} ms p99, n = {len(times) - 100}")
    added = 1e3 * (np.percentile(through[100:], [50, 99]) - np.percentile(straight[100:], [50, 99]))
    _compute(options.detector, options.model, options.setpoints)
    print(f"{'added':<17} {added[0]:.3f} ms median, {added[1]:.3f} ms p99")


if __name__ == "__main__":
    main()
