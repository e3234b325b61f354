"""Floods `mavfi sitl` with random, mutated and valid-looking frames, over UDP and TCP.

    python benchmarks/hostile_frames.py --frames 10000000
    python benchmarks/hostile_frames.py --frames 10000000 --signed

A third of the frames are random bytes, a third are valid frames with flipped bits, and a third are
frames with a correct checksum, of any message with any contents. They come from 8 UDP ports and 2
TCP connections, as fast as the server reads the TCP connections. An observer with a link of its own
measures the server's clock. With `--signed`, the server accepts only signed frames, the observer
signs, and nothing about the vehicle may change. The frames are seeded, but the order of their
arrival is not. The command exits with 1 if the server ends, its memory grows by more than 5 %, its
clock runs at less than half of real time, or a signed server obeys an unsigned frame.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import random
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.link.codec import Codec, Signing, dialect, key_from_passphrase

_KEY = "a passphrase of this benchmark"
_UDP_PORTS, _TCP_CONNECTIONS = 8, 2
_POOL = 20_000
_DATAGRAM = 1400
_BUFFER = 1 << 14  # bytes that may wait on our side of a TCP connection
_WARM_SHARE = 0.05  # of the frames, before memory counts
_LIKELY = ("COMMAND_LONG", "COMMAND_INT", "SET_MODE", "PARAM_SET", "PARAM_REQUEST_LIST",
           "SET_POSITION_TARGET_LOCAL_NED", "STATUSTEXT", "FILE_TRANSFER_PROTOCOL")  # fmt: skip
_FLOATS = (0.0, 1.0, -1.0, 4.0, 6.0, 30.0, math.nan, math.inf, 3e38)
_COMMANDS = (16, 20, 21, 22, 176, 179, 185, 192, 246, 400, 410, 511, 512, 520, 2000, 31010)


def hostile_frame(rng: random.Random) -> bytes:
    """Return random bytes, a mutated frame, or a valid frame with random contents."""
    kind = rng.randrange(3)
    if kind == 0:
        return rng.choice((b"", b"\xfd", b"\xfe")) + rng.randbytes(rng.randrange(1, 60))
    frame = valid_frame(rng)
    if kind == 1:
        mutated = bytearray(frame)
        for _ in range(rng.randrange(1, 5)):
            mutated[rng.randrange(len(mutated))] ^= 1 << rng.randrange(8)
        return bytes(mutated)
    return frame


def valid_frame(rng: random.Random) -> bytes:
    """Return a frame of a random message, with random contents and a correct checksum."""
    names = [cls.msgname for cls in dialect.mavlink_map.values()]
    name = rng.choice(_LIKELY) if rng.random() < 0.5 else rng.choice(names)
    cls = next(cls for cls in dialect.mavlink_map.values() if cls.msgname == name)
    fields = zip(cls.fieldnames, cls.fieldtypes, strict=True)
    lengths = dict(zip(cls.ordered_fieldnames, cls.array_lengths, strict=True))
    message = cls(*(_field(rng, name, kind, lengths[name]) for name, kind in fields))
    return Codec(rng.randrange(256), rng.randrange(256)).encode(message)


def _field(rng: random.Random, name: str, kind: str, length: int) -> Any:
    if kind == "char":
        return rng.choice((b"MPC_XY_VEL_MAX", rng.randbytes(min(length, 20))))
    if length:
        return [_scalar(rng, kind) for _ in range(length)]
    if name in ("target_system", "target_component", "target"):
        return rng.choice((0, 1, 1, 1, 100, 7))
    if name == "command":
        return rng.choice((*_COMMANDS, rng.randrange(65536)))
    return _scalar(rng, kind)


def _scalar(rng: random.Random, kind: str) -> float | int:
    if kind in ("float", "double"):
        return rng.choice((*_FLOATS, struct.unpack("<f", rng.randbytes(4))[0]))
    bits = int("".join(filter(str.isdigit, kind))) - (not kind.startswith("u"))
    return rng.choice((0, 1, rng.getrandbits(bits)))


def datagrams(seed: int, frames: int) -> list[tuple[bytes, int]]:
    """Return hostile frames in pieces that fit a packet, and the number of frames in each piece."""
    rng = random.Random(seed)
    pieces, piece, count = [], b"", 0
    for _ in range(frames):
        frame = hostile_frame(rng)
        if len(piece) + len(frame) > _DATAGRAM:
            pieces.append((piece, count))
            piece, count = b"", 0
        piece, count = piece + frame, count + 1
    return [*pieces, (piece, count)]


class Observer:
    """A client that requests messages, and measures the server's clock by LOCAL_POSITION_NED."""

    def __init__(self, port: int, *, signed: bool) -> None:
        signing = Signing(key_from_passphrase(_KEY), clock=time.time) if signed else None
        self._codec = Codec(245, 190, signing=signing)
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.settimeout(0.0)
        self._beat_s = 0.0
        self._boot_ms: int | None = None
        self.simulated_s = 0.0
        self.newest: dict[str, Any] = {}  # message by name
        self.was_armed = False

    def send(self, message: Any) -> None:
        """Send a message to the server, however long the server takes to accept it."""
        self._socket.settimeout(None)
        self._socket.sendall(self._codec.encode(message))
        self._socket.settimeout(0.0)

    def listen(self) -> None:
        """Handle all waiting messages, and send a heartbeat every second."""
        if time.monotonic() > self._beat_s + 1.0:
            self._beat_s = time.monotonic()
            self.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
        with contextlib.suppress(BlockingIOError):
            while data := self._socket.recv(1 << 16):
                for message in self._codec.decode(data):
                    self._take(message)

    def _take(self, message: Any) -> None:
        if message.get_srcComponent() != 1:
            return
        name = message.get_type()
        self.newest[name] = message
        if name == "HEARTBEAT":
            self.was_armed = self.was_armed or bool(message.base_mode & 128)
        elif name == "LOCAL_POSITION_NED":
            if self._boot_ms is not None and message.time_boot_ms > self._boot_ms:
                self.simulated_s += (message.time_boot_ms - self._boot_ms) * 1e-3
            self._boot_ms = message.time_boot_ms

    def ask(self, name: str, request: Any, limit_s: float = 60.0) -> Any:
        """Send a request until a message with the given name arrives, and return that message.

        Raises TimeoutError if none arrives within `limit_s`.
        """
        self.newest.pop(name, None)
        asked_s, until_s = 0.0, time.monotonic() + limit_s
        while name not in self.newest:
            if time.monotonic() > until_s:
                raise TimeoutError(f"the server did not send the requested {name}")
            if time.monotonic() > asked_s + 2.0:
                asked_s = time.monotonic()
                self.send(request)
            self.listen()
            time.sleep(0.01)
        return self.newest[name]

    def state(self) -> tuple[object, ...]:
        """Return what a command could change: the parameters' hash, the home and the mode."""
        asked = dialect.MAVLink_param_request_read_message(1, 1, b"_HASH_CHECK", -1)
        value = self.ask("PARAM_VALUE", asked)
        home = self.ask("HOME_POSITION", message_request(dialect.MAVLINK_MSG_ID_HOME_POSITION))
        beat = self.ask("HEARTBEAT", message_request(dialect.MAVLINK_MSG_ID_HEARTBEAT))
        bits = struct.pack("<f", value.param_value)
        return bits, home.latitude, home.longitude, home.altitude, beat.custom_mode

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def message_request(number: int) -> Any:
    """Return a COMMAND_LONG that requests a message by its id."""
    command = dialect.MAV_CMD_REQUEST_MESSAGE
    return dialect.MAVLink_command_long_message(1, 1, command, 0, number, 0, 0, 0, 0, 0, 0)


def free_port(kind: socket.SocketKind) -> int:
    """Return a TCP or UDP port of this machine that is not in use now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Server:
    """A running `mavfi sitl`."""

    process: subprocess.Popen[str]
    tcp: int
    udp: int
    output: Path

    def said(self) -> str:
        """Return everything that the server has printed so far."""
        return self.output.read_text()

    def lost_datagrams(self) -> int:
        """Return how many datagrams the system dropped because the server was too slow."""
        wanted = f":{self.udp:04X}"
        rows = Path("/proc/net/udp").read_text().splitlines()[1:]
        return sum(int(row.split()[-1]) for row in rows if row.split()[1].endswith(wanted))

    def resident_mb(self) -> float:
        """Return the resident memory of the server's process, in MB."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
        return int(line.split()[1]) / 1024


@contextlib.contextmanager
def running_server(*options: str, signed: bool = False) -> Iterator[Server]:
    """Run a server with one TCP and one UDP port while the context is active.

    Raises RuntimeError if the server ends by itself.
    """
    tcp, udp = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM)
    with tempfile.TemporaryDirectory() as folder:
        line = [sys.executable, "-m", "sitl", "--world", "farm", *options,
                "--link", f"tcpin:127.0.0.1:{tcp}", "--link", f"udpin:127.0.0.1:{udp}"]  # fmt: skip
        if signed:
            key = Path(folder) / "key"
            key.write_text(_KEY)
            line += ["--key-file", str(key)]
        errors = Path(folder) / "errors"
        with errors.open("w") as file:
            process = subprocess.Popen(line, stdout=file, stderr=file, text=True)
        try:
            while "Ctrl-C" not in errors.read_text():
                if process.poll() is not None:
                    raise RuntimeError(errors.read_text())
                time.sleep(0.1)
            yield Server(process=process, tcp=tcp, udp=udp, output=errors)
            if process.poll() is not None:
                raise RuntimeError(f"the server ended:\n{errors.read_text()}")
        finally:
            process.terminate()
            process.wait()


class _Flood:
    """The UDP sockets and TCP connections that flood the server, each in turn."""

    def __init__(self, server: Server) -> None:
        self._udp = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(_UDP_PORTS)]
        for each in self._udp:
            each.connect(("127.0.0.1", server.udp))
        self._tcp = [
            socket.create_connection(("127.0.0.1", server.tcp)) for _ in range(_TCP_CONNECTIONS)
        ]
        self._rests = [b""] * _TCP_CONNECTIONS
        for connection in self._tcp:
            connection.settimeout(0.0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._turn = 0

    def send(self, piece: bytes) -> bool:
        """Send a piece over TCP and over UDP. Return False if no TCP connection accepts it now."""
        for number, connection in enumerate(self._tcp):
            with contextlib.suppress(BlockingIOError):
                while connection.recv(1 << 16):  # what the server says to it
                    pass
            rest, self._rests[number] = self._rests[number] or piece, b""
            fresh = rest is piece
            with contextlib.suppress(BlockingIOError):
                rest = rest[connection.send(rest) :]
            self._rests[number] = rest if not fresh or len(rest) < len(piece) else b""
            if fresh and len(rest) < len(piece):
                self._turn = (self._turn + 1) % _UDP_PORTS
                with contextlib.suppress(OSError):
                    self._udp[self._turn].send(piece)
                return True
        return False

    def close(self) -> None:
        """Close all sockets."""
        for each in (*self._udp, *self._tcp):
            each.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """The effects of a flood on the server."""

    frames: int
    lost_datagrams: int  # of those sent over UDP
    wall_s: float
    growth: float  # of the memory, a share
    clock: float  # simulated seconds per second
    changed: bool  # armed, mode, parameters or home

    def problems(self, *, signed: bool) -> list[str]:
        """Return a line for every effect that a server must not show."""
        found = []
        if self.growth > 0.05:
            found.append(f"memory grew by {self.growth:.1%}")
        if self.clock < 0.5:
            found.append(f"the clock ran at {self.clock:.2f} of real time")
        if signed and self.changed:
            found.append("a signed server obeyed an unsigned frame")
        return found


def flood(frames: int, *, signed: bool, seed: int = 1) -> Report:
    """Flood a server with frames, half over TCP and half over UDP. Return the effects."""
    pieces = datagrams(seed, min(_POOL, frames))
    rng = random.Random(seed)
    with running_server(signed=signed) as server:
        observer = Observer(server.tcp, signed=signed)
        observer.ask("HOME_POSITION", message_request(dialect.MAVLINK_MSG_ID_HOME_POSITION))
        before = observer.state()
        attack = _Flood(server)
        start_s, simulated_s = time.monotonic(), observer.simulated_s
        sent, warm_mb = 0, 0.0
        while sent < frames and server.process.poll() is None:
            piece, count = rng.choice(pieces)
            if attack.send(piece):
                sent += 2 * count
            else:
                time.sleep(0.001)
            if not warm_mb and sent >= _WARM_SHARE * frames:
                warm_mb = server.resident_mb()
            observer.listen()
        wall_s = time.monotonic() - start_s
        clock = (observer.simulated_s - simulated_s) / wall_s
        attack.close()
        changed = observer.was_armed or observer.state() != before
        growth = server.resident_mb() / warm_mb - 1.0
        lost = server.lost_datagrams()
        observer.close()
    return Report(
        frames=sent, lost_datagrams=lost, wall_s=wall_s, growth=growth, clock=clock, changed=changed
    )


def main() -> None:
    """Flood a server, report the effects, and exit with 1 if there are problems."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--signed", action="store_true")
    given = parser.parse_args()
    report = flood(given.frames, signed=given.signed)
    change = "changed" if report.changed else "unchanged"
    print(f"{report.frames} frames in {report.wall_s:.0f} s; vehicle {change}")
    print(f"{report.lost_datagrams} datagrams of some 25 frames found no room")
    print(f"clock {report.clock:.2f} of real time; memory {report.growth:+.1%}")
    problems = report.problems(signed=given.signed)
    print("\n".join(problems) or "as it should be")
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
