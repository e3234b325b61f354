"""Hostile frames at a flying companion: from other systems, and with the autopilot's own ids.

    python benchmarks/hostile_flight.py --frames 1000000

Each flight is `mavfi fly --link` with a `mavfi sitl` behind a router, which passes all on.
Once the vehicle is in OFFBOARD, the router adds hostile frames. So they come from the autopilot's
own address, and nothing is signed. They have right checksums and are of every message that the
companion handles, with NaN, infinities, extremes and zeros. They are of other systems and
components, and the flight has to succeed. In the first flights (`--own`) they have the ids of the
autopilot and its camera, and the flight may succeed or end as `failsafe`. Frames count if the
companion has decoded them, which its tlog tells. The command ends with 1 after any other outcome.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from hostile_frames import free_port

from mavfi_cli.link import session, telemetry
from mavfi_cli.link.codec import Codec, dialect, frame_length
from mavfi_cli.link.images import IMAGE_MESSAGES

_HANDLED = sorted({*telemetry._HANDLERS, *session._HEARD, *IMAGE_MESSAGES})
_OWN = [(1, 1), (1, 1), (1, 100)]
_OTHERS = [(1, 101), (1, 190), (1, 0), (7, 1), (7, 100), (255, 190), (0, 1)]
_FLOATS = (0.0, -0.0, 1.0, -1.0, 5.0, math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, 9e3)
_POOL = 4000
_ALLOWED = {"others": {"success"}, "own ids": {"success", "failsafe"}}
_WORLD = ("--world", "farm", "--seed", "5", "--start=2,2,0")
_GOAL = "58,58,5"


def _scalar(rng: random.Random, kind: str) -> float | int:
    if kind in ("float", "double"):
        return rng.choice((*_FLOATS, rng.uniform(-1e3, 1e3)))
    bits = int("".join(filter(str.isdigit, kind)))
    low = 0 if kind.startswith("u") else -(2 ** (bits - 1))
    high = low + 2**bits - 1
    return rng.choice((low, high, 0, 1, rng.randint(low, high)))


def hostile_frame(rng: random.Random, sender: tuple[int, int]) -> bytes:
    """Return a frame of any message that the companion handles, with any contents."""
    cls = dialect.mavlink_map[rng.choice(_HANDLED)]
    lengths = dict(zip(cls.ordered_fieldnames, cls.array_lengths, strict=True))
    values: list[Any] = []
    for name, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True):
        if kind == "char":
            values.append(rng.choice((b"depth8:crc32=00000000", b"", rng.randbytes(lengths[name]))))
        elif lengths[name]:
            values.append([_scalar(rng, kind)] * lengths[name])
        else:
            values.append(_scalar(rng, kind))
    return Codec(*sender).encode(cls(*values))


class Router:
    """Passes datagrams between vehicle and companion, and adds frames once the vehicle follows.

    Args:
        rate_hz: Hostile frames a second.
    """

    def __init__(self, companion_port: int, frames: list[bytes], rate_hz: float) -> None:
        self.vehicle, self.companion = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)
        )
        self.vehicle.bind(("127.0.0.1", 0))
        self.companion.connect(("127.0.0.1", companion_port))
        for each in (self.vehicle, self.companion):
            each.settimeout(0.0)
        self._frames, self._rate_hz = frames, rate_hz
        self._codec, self._begun_s, self._sent = Codec(255, 255), 0.0, 0
        self._peer: Any = None

    def turn(self, rng: random.Random) -> None:
        """Pass on what waits, and send the hostile frames that are due."""
        for ready in select.select([self.vehicle, self.companion], [], [], 0.002)[0]:
            try:
                data, peer = ready.recvfrom(1 << 16)
                if ready is self.companion:
                    self.vehicle.sendto(data, self._peer)
                    continue
                self._peer = peer
                self._look(data)
                self.companion.send(data)
            except OSError:  # the companion does not listen yet, or has ended
                continue
        due = (time.monotonic() - self._begun_s) * self._rate_hz if self._begun_s else 0.0
        while self._sent < due:
            self._sent += 1
            try:
                self.companion.send(rng.choice(self._frames))
            except OSError:
                break

    def _look(self, data: bytes) -> None:
        for message in self._codec.decode(data, datagram=True) if not self._begun_s else ():
            if isinstance(message, dialect.MAVLink_heartbeat_message) and (
                message.custom_mode == 6 << 16 and message.base_mode & 128
            ):
                self._begun_s = time.monotonic()

    def close(self) -> None:
        """Close both sockets."""
        self.vehicle.close()
        self.companion.close()


def heard(tlog: Path, hostile: set[bytes]) -> int:
    """Return how many hostile frames the companion has decoded."""
    data, start, count = tlog.read_bytes(), 0, 0
    while (length := frame_length(data, start + 8, len(data))) > 0:
        count += data[start + 8 : start + 8 + length] in hostile
        start += 8 + length
    return count


def fly(kind: str, seed: int, rate_hz: float) -> tuple[str, str, int]:
    """Fly once among hostile frames. Return outcome, reason and the number of frames heard."""
    rng = random.Random(seed)
    senders = _OTHERS if kind == "others" else _OWN
    frames = [hostile_frame(rng, rng.choice(senders)) for _ in range(_POOL)]
    port = free_port(socket.SOCK_DGRAM)
    router = Router(port, frames, rate_hz)
    link = f"onboard=udpout:127.0.0.1:{router.vehicle.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder:
        vehicle = subprocess.Popen(
            [sys.executable, "-m", "sitl", *_WORLD, f"--goal={_GOAL}", "--link", link],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        select.select([router.vehicle], [], [])  # the vehicle has started
        line = ["fly", "--link", f"udpin:127.0.0.1:{port}", "--goal", _GOAL, "--out", folder]
        companion = subprocess.Popen(
            [sys.executable, "-m", "mavfi_cli", *line, "--quiet", "--json"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            while companion.poll() is None:
                router.turn(rng)
        finally:
            for process in (companion, vehicle):
                process.terminate()
            errors = companion.communicate()[1]
            vehicle.wait()
            router.close()
        if companion.returncode != 0:
            raise RuntimeError(errors)
        (run,) = Path(folder).iterdir()
        result = json.loads((run / "result.json").read_text())
        return result["outcome"], result["reason"], heard(run / "flight.tlog", set(frames))


def main() -> None:
    """Fly until enough frames were heard, and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--own", type=int, default=0, help="flights with the autopilot's own ids")
    parser.add_argument("--rate", type=float, default=4000.0, help="frames a second")
    given = parser.parse_args()
    counts, ends, flown, wrong = Counter[str](), Counter[tuple[str, str]](), 0, 0
    while counts["others"] < given.frames or flown < given.own:
        kind = "own ids" if flown < given.own else "others"
        outcome, reason, count = fly(kind, flown, given.rate)
        flown, wrong = flown + 1, wrong + (outcome not in _ALLOWED[kind])
        counts[kind] += count
        ends[kind, outcome] += 1
        print(f"{kind}: {count} frames, {outcome} {reason}", flush=True)
    for (kind, outcome), flights in sorted(ends.items()):
        print(f"{flights} flights with frames of {kind}: {outcome}")
    print(f"{sum(counts.values())} frames heard, {dict(counts)}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
