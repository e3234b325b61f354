"""Flies golden missions in real time over a bad UDP link to `mavfi sitl`.

    python benchmarks/bad_link.py --missions 10
    python benchmarks/bad_link.py --missions 3 --cut 3

A proxy between vehicle and companion drops, duplicates and delays datagrams, and thereby reorders
them, in both directions. `--cut S` makes it forward nothing for S seconds, beginning 20 s after the
first datagram. The proxy's random numbers are seeded, but the operating system's timing is not, so
runs differ.
"""

from __future__ import annotations

import argparse
import asyncio
import collections
import random
import socket
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass

import mavfi_cli as mavfi
from mavfi_cli import MissionConfig
from sitl.world import load_world

CUT_AT_S = 20.0  # after the first datagram: the vehicle is under way by then


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """How the proxy disturbs the datagrams."""

    loss: float  # probability
    jitter_s: float  # the delay is uniform in 0..jitter
    duplicates: float  # probability
    cut_s: float  # silence of this length


class Proxy(asyncio.DatagramProtocol):
    """One side of the proxy, which forwards the datagrams it receives to the other side's peer."""

    def __init__(self, conditions: Conditions, rng: random.Random) -> None:
        self.conditions, self.rng = conditions, rng
        self.to_peer: asyncio.DatagramTransport | None = None
        self.peer: tuple[str, int] | None = None
        self.other: Proxy | None = None
        self.first_s: float | None = None
        self.counts: collections.Counter[str] = collections.Counter()

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:
        """Keep the transport, so that `send` can use it."""
        self.to_peer = transport

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Schedule the forwarding of a datagram, unless the conditions drop it."""
        assert self.other is not None
        self.peer = addr
        loop = asyncio.get_running_loop()
        self.first_s = self.first_s or loop.time()
        since_s = loop.time() - self.first_s
        self.counts["heard"] += 1
        if CUT_AT_S <= since_s < CUT_AT_S + self.conditions.cut_s:
            self.counts["cut"] += 1
            return
        if self.rng.random() < self.conditions.loss:
            self.counts["lost"] += 1
            return
        copies = 2 if self.rng.random() < self.conditions.duplicates else 1
        self.counts["duplicated"] += copies - 1
        for _ in range(copies):
            loop.call_later(self.rng.uniform(0.0, self.conditions.jitter_s), self.other.send, data)

    def send(self, data: bytes) -> None:
        """Send a datagram to the peer of this side, if the peer's address is known."""
        if self.to_peer is not None and self.peer is not None:
            self.to_peer.sendto(data, self.peer)


async def relay(vehicle: Proxy, companion: Proxy, ports: tuple[int, int]) -> None:
    """Forward datagrams between the vehicle on the first port and the companion on the second."""
    loop = asyncio.get_running_loop()
    companion.peer = ("127.0.0.1", ports[1])
    await loop.create_datagram_endpoint(lambda: vehicle, local_addr=("127.0.0.1", ports[0]))
    await loop.create_datagram_endpoint(lambda: companion, local_addr=("127.0.0.1", 0))


def free_ports(count: int) -> list[int]:
    """Return UDP ports of this machine that are not in use now."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def fly(seed: int, conditions: Conditions, world: str, out: str) -> dict[str, object]:
    """Fly one mission through a proxy of its own, and return the mission's result."""
    ports = free_ports(2)
    rng = random.Random(seed)
    vehicle, companion = Proxy(conditions, rng), Proxy(conditions, rng)
    vehicle.other, companion.other = companion, vehicle
    loop = asyncio.new_event_loop()
    loop.run_until_complete(relay(vehicle, companion, (ports[0], ports[1])))
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    place = load_world(world, seed=seed)
    link = f"onboard=udpout:127.0.0.1:{ports[0]}"
    line = [sys.executable, "-m", "sitl", "--world", world, "--seed", str(seed), "--link", link]
    with subprocess.Popen(line, stderr=subprocess.DEVNULL) as process:
        try:
            config = MissionConfig(
                seed=seed, goal=tuple(place.goal_enu_m.tolist()), land=True,
                link=f"udpin:127.0.0.1:{ports[1]}",
            )  # fmt: skip
            result = mavfi.fly(config, out=out).result
        finally:
            process.kill()
            loop.call_soon_threadsafe(loop.stop)
            thread.join()
    counts = vehicle.counts + companion.counts
    print(f"seed {seed}: {result['outcome']} {result['reason']} after "
          f"{result['quality_of_flight']['flight_time_s']} s; datagrams {dict(counts)}",
          flush=True)  # fmt: skip
    return result


def main() -> None:
    """Fly the missions, and count their outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=10)
    parser.add_argument("--world", default="sparse")
    parser.add_argument("--loss", type=float, default=0.05)
    parser.add_argument("--jitter", type=float, default=0.05, help="s")
    parser.add_argument("--duplicates", type=float, default=0.02)
    parser.add_argument("--cut", type=float, default=0.0, help="s")
    given = parser.parse_args()
    conditions = Conditions(
        loss=given.loss, jitter_s=given.jitter, duplicates=given.duplicates, cut_s=given.cut
    )
    with tempfile.TemporaryDirectory() as out:
        ends = [fly(seed, conditions, given.world, out)["outcome"]
                for seed in range(1, given.missions + 1)]  # fmt: skip
    print(f"{given.missions} golden missions in {given.world}: {dict(collections.Counter(ends))}")


if __name__ == "__main__":
    main()
