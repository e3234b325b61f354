"""Every transport passes the same suite: a pair of ends, by whatever URL."""

from __future__ import annotations

import os
import pty
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator

import pytest
from transport_contract import WAIT_S, Pair, StreamTransportContract, TransportContract

from mavfi_cli.core.errors import LinkError, LinkLost
from mavfi_cli.link.codec import Codec, Signing, begins_with_frame, dialect, key_from_passphrase
from mavfi_cli.link.transport import Transport, memory_pair, open_listener, open_transport

introduce, message = TransportContract.introduce, TransportContract.message
receive, send = TransportContract.receive, TransportContract.send

HEARTBEAT = dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)


def _socket_pair() -> Iterator[Pair]:
    ends = socket.socketpair()
    near, far = (open_transport(f"fd:{end.detach()}") for end in ends)
    yield near, far
    near.close()
    far.close()


def _memory() -> Iterator[Pair]:
    near, far = memory_pair("in memory")
    yield near, far
    near.close()
    far.close()


def _udp() -> Iterator[Pair]:
    near = open_transport("udpin:127.0.0.1:0")
    far = open_transport(f"udpout:127.0.0.1:{near.port}")  # type: ignore[attr-defined]
    yield near, far
    near.close()
    far.close()


def _tcp() -> Iterator[Pair]:
    near = open_transport("tcpin:127.0.0.1:0")
    far = open_transport(f"tcp:127.0.0.1:{near.port}")  # type: ignore[attr-defined]
    yield near, far
    near.close()
    far.close()


def _listened(scheme: str, caller: str) -> Iterator[Pair]:
    listener = open_listener(f"{scheme}:127.0.0.1:0")
    far = open_transport(f"{caller}:127.0.0.1:{listener.port}")  # type: ignore[attr-defined]
    far.send(Codec(9, 9).encode(message(0)))
    peers: list[Transport] = []
    while not peers:
        assert _wait_readable(listener.fileno())
        peers += listener.accept_ready()
    assert Codec(8, 8).decode(peers[0].receive(WAIT_S))
    yield peers[0], far
    peers[0].close()
    far.close()
    listener.close()


def _serial() -> Iterator[Pair]:
    """Two pseudo-terminals, and a thread that carries bytes between their controlling ends."""
    (left, left_name), (right, right_name) = _raw_terminal(), _raw_terminal()
    near, far = open_transport(f"serial:{left_name}:115200"), open_transport(f"serial:{right_name}")
    stop_read, stop_write = os.pipe()
    carrier = threading.Thread(target=_carry, args=(left, right, stop_read))
    carrier.start()
    yield near, far
    os.close(stop_write)
    carrier.join()
    near.close()
    far.close()
    for descriptor in (left, right, stop_read):
        os.close(descriptor)


def _raw_terminal() -> tuple[int, str]:
    controller, terminal = pty.openpty()
    tty.setraw(terminal)
    name = os.ttyname(terminal)
    _OPEN_TERMINALS.append(terminal)  # or the terminal hangs up before it is opened by name
    return controller, name


_OPEN_TERMINALS: list[int] = []


def _carry(left: int, right: int, stop: int) -> None:
    while True:
        ready, _, _ = select.select([left, right, stop], [], [])
        if stop in ready:
            return
        for source, sink in ((left, right), (right, left)):
            if source in ready:
                os.write(sink, os.read(source, 4096))


def _wait_readable(descriptor: int) -> bool:
    return bool(select.select([descriptor], [], [], WAIT_S)[0])


MAKERS: dict[str, Callable[[], Iterator[Pair]]] = {
    "socket pair": _socket_pair,
    "udp": _udp,
    "tcp": _tcp,
    "udp listener": lambda: _listened("udpin", "udpout"),
    "tcp listener": lambda: _listened("tcpin", "tcp"),
    "serial": _serial,
    "memory": _memory,
}
STREAMS = ("socket pair", "tcp", "tcp listener", "memory")
WITH_DESCRIPTOR = tuple(kind for kind in MAKERS if kind != "memory")


@pytest.fixture(params=MAKERS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def pair(kind: str) -> Iterator[Pair]:
    yield from MAKERS[kind]()
    while _OPEN_TERMINALS:
        os.close(_OPEN_TERMINALS.pop())


@pytest.mark.parametrize("kind", STREAMS, indirect=True)
class TestStreams(StreamTransportContract):
    pass


@pytest.mark.parametrize("kind", [kind for kind in MAKERS if kind not in STREAMS], indirect=True)
class TestOtherTransports(TransportContract):
    pass


@pytest.mark.parametrize("kind", WITH_DESCRIPTOR, indirect=True)
def test_the_descriptor_becomes_readable(pair: Pair) -> None:
    near, far = pair
    introduce(near, far)
    send(near, Codec(1, 1), range(1))
    assert _wait_readable(far.fileno())
    assert receive(far, 1) == [0]


@pytest.mark.parametrize("kind", WITH_DESCRIPTOR, indirect=True)
def test_a_wait_without_end_is_ended_by_data(pair: Pair) -> None:
    near, far = pair
    introduce(near, far)
    sender = threading.Timer(0.01, send, (near, Codec(1, 1), range(1)))
    sender.start()
    assert far.receive(float("inf"))
    sender.join()


def test_in_memory_the_other_end_acts_while_one_waits() -> None:
    near, far = memory_pair("in memory")
    near.on_wait = lambda: far.send(b"answer to " + far.receive(0.0))
    near.send(b"one")
    assert near.receive(WAIT_S) == b"answer to one"
    near.on_wait = far.close
    with pytest.raises(LinkLost, match=r"^in memory: "):
        near.receive(WAIT_S)
    with pytest.raises(LinkLost):
        near.send(b"two")


def test_a_serial_device_that_goes_away_is_a_lost_link() -> None:
    controller, name = _raw_terminal()
    port = open_transport(f"serial:{name}:57600")
    os.close(controller)
    with pytest.raises(LinkLost, match="serial device failed"):
        port.receive(WAIT_S)
    port.close()
    os.close(_OPEN_TERMINALS.pop())


@pytest.mark.parametrize("kind", ["udp", "udp listener"], indirect=True)
def test_a_udp_peer_that_is_not_there_is_no_error(pair: Pair) -> None:
    near, far = pair
    near.close()
    for _ in range(3):
        far.send(Codec(1, 1).encode(message(0)))
        assert far.receive(0.0) == b""


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
def test_a_port_in_use_is_one_clear_line(scheme: str) -> None:
    first = open_transport(f"{scheme}:127.0.0.1:0")
    port = first.port  # type: ignore[attr-defined]
    for opener in (open_transport, open_listener):
        with pytest.raises(LinkError, match=f"port {port} is in use"):
            opener(f"{scheme}:127.0.0.1:{port}")
    first.close()


def test_nobody_listening_is_one_clear_line() -> None:
    vacant = socket.socket()
    vacant.bind(("127.0.0.1", 0))
    port = vacant.getsockname()[1]
    with pytest.raises(LinkError, match="nothing listens there"):
        open_transport(f"tcp:127.0.0.1:{port}")
    vacant.close()


def test_an_inherited_descriptor_must_be_a_connected_stream_socket() -> None:
    read, write = os.pipe()
    lonely = socket.socket()
    packets = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    cases = {
        f"fd:{read}": "not a socket",
        f"fd:{lonely.fileno()}": "not a connected socket",
        f"fd:{packets[0].fileno()}": "not a stream socket",
        "fd:9999": "not an open descriptor",
    }
    for url, problem in cases.items():
        with pytest.raises(LinkError, match=problem):
            open_transport(url)
    for descriptor in (read, write):
        os.close(descriptor)
    for opened in (lonely, *packets):
        opened.close()


def test_several_clients_of_one_listener_are_kept_apart() -> None:
    for scheme, caller in (("udpin", "udpout"), ("tcpin", "tcp")):
        listener = open_listener(f"{scheme}:127.0.0.1:0")
        url = f"{caller}:127.0.0.1:{listener.port}"  # type: ignore[attr-defined]
        callers = [open_transport(url) for _ in range(3)]
        peers: list[Transport] = []
        for number, client in enumerate(callers):
            send(client, Codec(2, 2), range(number, number + 1))
            while len(peers) <= number:
                assert _wait_readable(listener.fileno())
                peers += listener.accept_ready()
        for number, (peer, client) in enumerate(zip(peers, callers, strict=True)):
            assert receive(peer, 1) == [number]
            send(peer, Codec(1, 1), range(10 + number, 11 + number))
            assert receive(client, 1) == [10 + number]
        for opened in (*callers, *peers, listener):
            opened.close()


@pytest.mark.parametrize(("scheme", "caller"), [("udpin", "udpout"), ("tcpin", "tcp")])
def test_a_full_listener_welcomes_somebody_once_a_peer_has_left(scheme: str, caller: str) -> None:
    from mavfi_cli.link.transport import MAX_PEERS

    listener = open_listener(f"{scheme}:127.0.0.1:0")
    url = f"{caller}:127.0.0.1:{listener.port}"  # type: ignore[attr-defined]
    callers, peers = [], []
    for number in range(MAX_PEERS + 2):
        callers.append(open_transport(url))
        if scheme == "udpin":
            send(callers[-1], Codec(2, 2), range(1))
        assert _wait_readable(listener.fileno())
        fresh = listener.accept_ready()
        assert len(fresh) == (number < MAX_PEERS)
        peers += fresh
    assert not any(map(_is_lost, peers))
    peers.pop().close()
    callers.append(open_transport(url))
    send(callers[-1], Codec(2, 2), range(1))
    assert _wait_readable(listener.fileno())
    fresh = listener.accept_ready()
    assert len(fresh) == 1
    peers += fresh
    for opened in (*callers, *peers, listener):
        opened.close()


def test_a_udp_listener_admits_only_whom_it_is_told_to() -> None:
    listener = open_listener("udpin:127.0.0.1:0", admits=begins_with_frame)
    caller = open_transport(f"udpout:127.0.0.1:{listener.port}")  # type: ignore[attr-defined]
    frame = Codec(2, 2).encode(message(0))
    for data, welcome in ((b"\xfd", 0), (b"\xfd" * 40, 0), (frame[:-1], 0), (frame, 1)):
        caller.send(data)
        assert _wait_readable(listener.fileno())
        assert len(listener.accept_ready()) == welcome
    caller.close()
    listener.close()


def _is_lost(peer: Transport) -> bool:
    try:
        while peer.receive(0.0):
            pass
    except LinkLost:
        return True
    return False


def test_noise_does_not_make_a_udp_peer() -> None:
    listener = open_listener("udpin:127.0.0.1:0")
    address = ("127.0.0.1", listener.port)  # type: ignore[attr-defined]
    noise = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for datagram in (b"", b"GET / HTTP/1.1\r\n", b"\x00" * 9):
        noise.sendto(datagram, address)
        assert _wait_readable(listener.fileno())
        assert listener.accept_ready() == []
    noise.close()
    listener.close()


def test_a_slow_reader_of_a_listener_loses_the_oldest_and_blocks_nobody() -> None:
    listener = open_listener("tcpin:127.0.0.1:0")
    client = open_transport(f"tcp:127.0.0.1:{listener.port}")  # type: ignore[attr-defined]
    assert _wait_readable(listener.fileno())
    (peer,) = listener.accept_ready()
    codec, batch, batches = Codec(1, 1), 20, 20_000
    for number in range(batches):
        peer.send(b"".join(codec.encode(message(number)) for _ in range(batch)))
    decoder, got = Codec(2, 2), []
    while data := client.receive(0.2):
        got += [each.time_boot_ms for each in decoder.decode(data)]
        peer.send(b"")  # lets what waits out
    assert decoder.bad_bytes == 0
    assert got == sorted(got)
    assert got[-1] == batches - 1  # the newest arrives
    assert len(got) < batch * batches / 4
    for opened in (client, peer, listener):
        opened.close()


def test_one_peer_endpoints_serve_as_listeners_too() -> None:
    ends = socket.socketpair()
    far = open_transport(f"fd:{ends[1].detach()}")
    listener = open_listener(f"fd:{ends[0].detach()}")
    (peer,) = listener.accept_ready()
    assert listener.accept_ready() == []
    send(far, Codec(2, 2), range(1))
    assert _wait_readable(listener.fileno())
    assert receive(peer, 1) == [0]
    far.close()
    listener.close()


def test_a_udp_port_keeps_its_first_valid_sender_until_that_is_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Commands would go to whoever spoke last, and be heard from anybody, otherwise."""
    frame = [Codec(system, 1).encode(HEARTBEAT) for system in (1, 2)]
    near = open_transport("udpin:127.0.0.1:0")
    url = f"udpout:127.0.0.1:{near.port}"  # type: ignore[attr-defined]
    stranger, first, second = (open_transport(url) for _ in range(3))
    try:
        stranger.send(b"\xfd no frame")
        near.send(b"to nobody")
        first.send(frame[0])
        assert near.receive(1.0) == frame[0]
        second.send(frame[1])
        assert near.receive(0.2) == b""
        near.send(b"answer")
        assert first.receive(1.0) == b"answer"
        assert second.receive(0.0) == stranger.receive(0.0) == b""
        monkeypatch.setattr(near._slot, "_silent_from_s", 0.0)  # type: ignore[attr-defined]
        second.send(frame[1])
        assert near.receive(1.0) == frame[1]
        near.send(b"answer")
        assert second.receive(1.0) == b"answer"
    finally:
        for each in (near, stranger, first, second):
            each.close()


def test_a_signed_udp_port_takes_no_unsigned_sender() -> None:
    signing = [Signing(key_from_passphrase("horse"), time.time) for _ in range(2)]
    near = open_transport("udpin:127.0.0.1:0", signed=True, admits=signing[0].authenticates)
    far = open_transport(f"udpout:127.0.0.1:{near.port}")  # type: ignore[attr-defined]
    try:
        far.send(Codec(1, 1).encode(HEARTBEAT))
        assert near.receive(0.2) == b""
        frame = Codec(1, 1, signing=signing[1]).encode(HEARTBEAT)
        far.send(frame)
        assert near.receive(1.0) == frame
    finally:
        near.close()
        far.close()


@pytest.mark.parametrize(
    ("component", "outlived", "is_rival"),
    [
        pytest.param(1, True, True, id="two autopilots"),
        pytest.param(1, False, False, id="an autopilot that restarts at another port"),
        pytest.param(190, True, False, id="a ground station"),
    ],
)
def test_a_udp_port_tells_a_second_autopilot(
    component: int, outlived: bool, is_rival: bool
) -> None:
    near = open_transport("udpin:127.0.0.1:0")
    url = f"udpout:127.0.0.1:{near.port}"  # type: ignore[attr-defined]
    first, second = (open_transport(url) for _ in range(2))
    try:
        first.send(Codec(1, 1).encode(HEARTBEAT))
        second.send(Codec(1, component).encode(HEARTBEAT))
        assert near.receive(1.0)
        assert near.receive(0.1) == b""
        if outlived:
            first.send(Codec(1, 1).encode(HEARTBEAT))
            assert near.receive(1.0)
        port = second._socket.getsockname()[1]  # type: ignore[attr-defined]
        assert near.rival_address == (f"127.0.0.1:{port}" if is_rival else "")
    finally:
        for each in (near, first, second):
            each.close()
