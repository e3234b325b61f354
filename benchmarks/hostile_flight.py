"""Sends hostile frames to a flying companion, from other systems and with the autopilot's ids.

    python benchmarks/hostile_flight.py --frames 1000000 --rate 8000
    python benchmarks/hostile_flight.py --frames 0 --own 4

Each flight is `mavfi fly --link` with a `mavfi sitl` behind a router, which forwards everything.
Once the vehicle is in OFFBOARD, the router adds hostile frames. They thus come from the autopilot's
own address, and nothing is signed. They have correct checksums and are of every message that the
companion handles, with NaN, infinities, extreme values and zeros.

`--frames` is the least number of frames of other systems and components. These flights must
succeed. `--own` is the number of flights of each kind with the ids of the autopilot and its camera:
first with every message, then without those by which an autopilot ends or steers a flight. Up to
half of these frames are the vehicle's newest messages with some fields changed, slightly or to any
value, so that stamps and places are plausible. These flights may have any outcome except `crash`
and `hang`.

A frame counts if the companion has decoded it, as its tlog shows. The command exits with 1 after
any other outcome, a traceback, a flight of more than 10 minutes, or another exit code of a flight.
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hostile_frames import free_port

from mavfi_cli.link import session, telemetry
from mavfi_cli.link.codec import Codec, dialect, frame_length
from mavfi_cli.link.images import IMAGE_MESSAGES

_Sender = tuple[int, int]
_HANDLED = {*telemetry._HANDLERS, *session._HANDLED, *IMAGE_MESSAGES}
_OWN = [(1, 1), (1, 1), (1, 100)]
_OTHERS = [(1, 101), (1, 190), (1, 0), (7, 1), (7, 100), (255, 190), (0, 1)]
_HEARTBEAT = dialect.MAVLINK_MSG_ID_HEARTBEAT
_POSITION = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
_WITHOUT = {
    "others": set[int](),
    "own ids": set[int](),
    "own ids without HEARTBEAT": {_HEARTBEAT},
    "own ids without HEARTBEAT and images": {_HEARTBEAT, *IMAGE_MESSAGES},
    "own ids without HEARTBEAT, images and position": {_HEARTBEAT, *IMAGE_MESSAGES, _POSITION},
}  # kinds of flight, and the messages that their hostile frames are none of
_FLOATS = (0.0, -0.0, 1.0, -1.0, 5.0, math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, 9e3)
_POOL = 4000
_CHANGED = 0.3  # share of fields that differ from the vehicle's message
_LIMIT_S = 600.0  # of a flight, on the wall clock
_FAIR = {"success", "failsafe", "timeout", "link_lost", "collision", "no_path"}
_WORLD = ("--world", "farm", "--seed", "5", "--start=2,2,0")
_GOAL = "58,58,5"


def _scalar(rng: random.Random, kind: str) -> float | int:
    if kind in ("float", "double"):
        return rng.choice((*_FLOATS, rng.uniform(-1e3, 1e3)))
    bits = int("".join(filter(str.isdigit, kind)))
    low = 0 if kind.startswith("u") else -(2 ** (bits - 1))
    high = low + 2**bits - 1
    return rng.choice((low, high, 0, 1, rng.randint(low, high)))


def _near(rng: random.Random, value: float, kind: str) -> float | int:
    """Return a random value near a true value, such as the stamp of the next message."""
    if kind in ("float", "double"):
        return value + rng.gauss(0.0, 2.0)
    bits = int("".join(filter(str.isdigit, kind))) - (not kind.startswith("u"))
    return max(0, min(int(value) + rng.randint(-5, 40), (1 << bits) - 1))


def hostile_frame(rng: random.Random, cls: Any, sender: _Sender, true: Any = None) -> bytes:
    """Return a frame with random contents, or with those of a true message except some fields."""
    lengths = dict(zip(cls.ordered_fieldnames, cls.array_lengths, strict=True))
    values: list[Any] = []
    for name, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True):
        if true is not None and rng.random() > _CHANGED:
            value = getattr(true, name)
            values.append(value.encode() if isinstance(value, str) else value)
        elif kind == "char":
            values.append(rng.choice((b"depth8:crc32=00000000", b"", rng.randbytes(lengths[name]))))
        elif lengths[name]:
            values.append([_scalar(rng, kind)] * lengths[name])
        elif true is not None and rng.random() < 0.5:
            values.append(_near(rng, getattr(true, name), kind))
        else:
            values.append(_scalar(rng, kind))
    return Codec(*sender).encode(cls(*values))


class Router:
    """Passes datagrams between vehicle and companion, and adds frames once the vehicle follows.

    Args:
        frame: Makes a hostile frame from the vehicle's newest messages, by component and id.
        rate_hz: Hostile frames a second.
    """

    def __init__(
        self, companion_port: int, frame: Callable[[dict[_Sender, Any]], bytes], rate_hz: float
    ) -> None:
        self.vehicle, self.companion = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)
        )
        self.vehicle.bind(("127.0.0.1", 0))
        self.companion.connect(("127.0.0.1", companion_port))
        for each in (self.vehicle, self.companion):
            each.settimeout(0.0)
        self._frame, self._rate_hz = frame, rate_hz
        self._codec, self._begun_s, self._count = Codec(255, 255), 0.0, 0
        self._newest: dict[_Sender, Any] = {}
        self._peer: Any = None
        self.sent: set[bytes] = set()

    def turn(self) -> None:
        """Forward the waiting datagrams, and send the hostile frames that are due."""
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
        while self._count < due:
            self._count += 1
            frame = self._frame(self._newest)
            try:
                self.companion.send(frame)
            except OSError:
                break
            self.sent.add(frame)

    def _look(self, data: bytes) -> None:
        for message in self._codec.decode(data, datagram=True):
            self._newest[message.get_srcComponent(), type(message).id] = message
            if (
                not self._begun_s
                and isinstance(message, dialect.MAVLink_heartbeat_message)
                and (message.custom_mode == 6 << 16 and message.base_mode & 128)
            ):
                self._begun_s = time.monotonic()

    def close(self) -> None:
        """Close both sockets."""
        self.vehicle.close()
        self.companion.close()


def heard(tlog: Path, hostile: set[bytes]) -> int:
    """Return how many hostile frames the companion has decoded, according to its tlog."""
    data, start, count = tlog.read_bytes(), 0, 0
    while (length := frame_length(data, start + 8, len(data))) > 0:
        count += data[start + 8 : start + 8 + length] in hostile
        start += 8 + length
    return count


def frame_maker(kind: str, rng: random.Random) -> Callable[[dict[_Sender, Any]], bytes]:
    """Return a function that makes the hostile frames of a kind of flight."""
    classes = [dialect.mavlink_map[number] for number in sorted(_HANDLED - _WITHOUT[kind])]
    if kind == "others":
        pool = [hostile_frame(rng, rng.choice(classes), rng.choice(_OTHERS)) for _ in range(_POOL)]
        return lambda _: rng.choice(pool)

    def frame(newest: dict[_Sender, Any]) -> bytes:
        cls, sender = rng.choice(classes), rng.choice(_OWN)
        true = newest.get((sender[1], cls.id)) if rng.random() < 0.5 else None
        return hostile_frame(rng, cls, sender, true)

    return frame


def fly(kind: str, seed: int, rate_hz: float) -> tuple[str, str, int]:
    """Fly once among hostile frames. Return outcome, reason and the number of decoded frames."""
    port = free_port(socket.SOCK_DGRAM)
    router = Router(port, frame_maker(kind, random.Random(seed)), rate_hz)
    link = f"onboard=udpout:127.0.0.1:{router.vehicle.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder:
        vehicle = subprocess.Popen(
            [sys.executable, "-m", "sitl", *_WORLD, f"--goal={_GOAL}", "--link", link],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        select.select([router.vehicle], [], [])  # the vehicle has started
        link = f"udpin:127.0.0.1:{port}"
        line = ["fly", "--link", link, "--goal", _GOAL, "--out", folder, "--time-limit", "60"]
        errors = Path(folder, "errors")
        with errors.open("w") as file:
            companion = subprocess.Popen(
                [sys.executable, "-m", "mavfi_cli", *line, "--quiet"], stdout=file, stderr=file
            )
        until_s = time.monotonic() + _LIMIT_S
        try:
            while companion.poll() is None and time.monotonic() < until_s:
                router.turn()
            hung = companion.poll() is None
        finally:
            for process in (companion, vehicle):
                process.terminate()
                process.wait()
            router.close()
        text = errors.read_text()
        if hung or companion.returncode != 0 or "Traceback" in text:
            raise RuntimeError(f"{kind}: {'the companion hung ' * hung}{text}")
        (record,) = Path(folder).glob("*/result.json")
        result, run = json.loads(record.read_text()), record.parent
        return result["outcome"], result["reason"], heard(run / "flight.tlog", router.sent)


def main() -> None:
    """Fly until the companion has decoded enough hostile frames, and report the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--own", type=int, default=0, help="flights with the autopilot's own ids")
    parser.add_argument("--rate", type=float, default=4000.0, help="frames a second")
    given = parser.parse_args()
    counts, ends, wrong = Counter[str](), Counter[tuple[str, str]](), 0
    kinds = [kind for kind in _WITHOUT if kind != "others" for _ in range(given.own)]
    while kinds or counts["others"] < given.frames:
        kind = kinds.pop(0) if kinds else "others"
        outcome, reason, count = fly(kind, ends.total(), given.rate)
        wrong += outcome not in ({"success"} if kind == "others" else _FAIR)
        counts[kind] += count
        ends[kind, outcome] += 1
        print(f"{kind}: {count} frames, {outcome} {reason}", flush=True)
    for (kind, outcome), flights in sorted(ends.items()):
        print(f"{flights} flights with frames of {kind}: {outcome}")
    print(f"{counts.total()} frames heard, {dict(counts)}")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
