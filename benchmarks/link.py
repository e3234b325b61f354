"""Measures the CPU time of the MAVLink link on the bytes of one golden flight, without flying.

    python benchmarks/link.py [--repeats 9] [--tlog flight.tlog]

Both ends do what they do in a flight. The vehicle encodes its messages and decodes the companion's.
The companion decodes messages, assembles images, keeps telemetry, sends a setpoint per tick and
writes the tlog. Other load on the machine hardly affects the best repeat, whereas it would affect
the shares of time in a flight.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from missions import fly

from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.images import IMAGE_MESSAGES, ImageReceiver
from mavfi_cli.link.session import OffboardSession, SessionSettings
from mavfi_cli.link.tlog import RecordedLink
from mavfi_cli.link.transport import memory_pair

COMPANION = dialect.MAV_COMP_ID_ONBOARD_COMPUTER


def vehicle_ticks(tlog: bytes) -> list[tuple[float, bytes]]:
    """Return the stamp of every tick, s, and the bytes that the vehicle sent in it."""
    ticks: dict[float, list[bytes]] = {}
    place = 0
    while place < len(tlog):
        stamp_s = int.from_bytes(tlog[place : place + 8], "big") / 1e6
        frame = tlog[place + 8 : place + 8 + tlog[place + 9] + 12]
        place += 8 + len(frame)
        if frame[6] != COMPANION:
            ticks.setdefault(stamp_s, []).append(frame)
    first_s = next(iter(ticks))
    return [(stamp_s - first_s, b"".join(frames)) for stamp_s, frames in ticks.items()]


def link_cpu_s(ticks: list[tuple[float, bytes]], sent: list[Message], tlog: Path) -> float:
    """Return the CPU time, in seconds, of both ends of the link for the ticks of a flight."""
    ours, theirs = memory_pair("the benchmark")
    link, vehicle = RecordedLink(ours, 1, COMPANION), Codec(1, 1)
    session = OffboardSession(SessionSettings(takeoff_height_m=5.0, request_streams=False))
    images, mount = ImageReceiver(), np.zeros(3)
    begun_s = time.process_time()
    with link.recording(tlog):
        for stamp_s, data in ticks:
            for message in link.messages(data, stamp_s):
                if type(message).id not in IMAGE_MESSAGES:
                    session.handle(message)
                    continue
                for image in images.feed(message):
                    pose = session.state_at(image.stamp_s)
                    if pose is not None:
                        image.depth_frame(pose, hfov_rad=1.5, mount_offset_flu_m=mount)
            session.set_target([1.0, 2.0, 0.3], 0.4, [0.1, 0.2, 0.3])
            link.send(session.tick(stamp_s), stamp_s)
            vehicle.decode(theirs.receive(0.0))
        for message in sent:
            vehicle.encode(message)
    return time.process_time() - begun_s


def main() -> None:
    """Fly once or read a tlog, repeat the work on its link, and print the best and median time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--tlog", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if given.tlog is None:
            fly("--out", folder)
        tlog = given.tlog or next(Path(folder).glob("*/flight.tlog"))
        ticks = vehicle_ticks(tlog.read_bytes())
        sent = [message for _, data in ticks for message in Codec(9, 9).decode(data)]
        times = sorted(
            link_cpu_s(ticks, sent, Path(folder) / "link.tlog") for _ in range(given.repeats + 1)
        )
    per_s = [1e3 * each / ticks[-1][0] for each in times]
    print(f"{ticks[-1][0]:.1f} simulated seconds, {given.repeats} repeats: ms a simulated second: "
          f"best {per_s[0]:.2f}, median {per_s[len(per_s) // 2]:.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
