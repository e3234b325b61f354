"""Transports, opened by URL, that carry bytes to and from one peer."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from typing import Protocol

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import begins_with_frame
from mavfi_cli.link.datagrams import UdpListener, UdpTransport
from mavfi_cli.link.endpoint import LISTENING, parse_endpoint
from mavfi_cli.link.streams import FirstClient, SerialPort, StreamTransport, TcpListener


class Transport(Protocol):
    """Bytes to and from one peer."""

    @property
    def url(self) -> str:
        """URL of the endpoint, for error messages."""

    @property
    def datagram(self) -> bool:
        """True if every `receive` returns whole frames; an argument of `Codec.decode`."""

    @property
    def address(self) -> str:
        """Address of a network peer, for error messages; "" if unknown."""

    @property
    def rival_address(self) -> str:
        """Address of an autopilot that sends here beside the peer; "" without one."""

    def send(self, data: bytes) -> None:
        """Send whole frames. Datagrams may be lost. Raises LinkLost if the peer has closed."""

    def receive(self, timeout_s: float) -> bytes:
        """Return the next bytes, or b"" after `timeout_s` (inf waits without end).

        Raises:
            LinkLost: The peer closed the connection, or the device was removed.
        """

    def fileno(self) -> int:
        """The descriptor that becomes readable when `receive` would return something; -1: none."""

    def close(self) -> None:
        """Release the socket or device. May be called repeatedly."""


class Listener(Protocol):
    """Peers of one URL: every client of a listening URL, the single peer of any other."""

    def accept_ready(self) -> Sequence[Transport]:
        """Return the peers that appeared since the last call, without waiting."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when `accept_ready` may return peers."""

    def close(self) -> None:
        """Stop listening. This closes UDP peers, too, because they share the socket."""


def open_transport(
    url: str,
    *,
    signed: bool = False,
    allow_unsigned: bool = False,
    admits: Callable[[bytes], bool] = begins_with_frame,
) -> Transport:
    """Open one end of a link.

    Args:
        url: `udpin:[host]:port`, `udpout:host:port`, `tcp:host:port`, `tcpin:[host]:port`,
            `serial:device[:baud]` or `fd:number`; without a host it listens on loopback.
        signed: The caller signs this link, so it may reach beyond this machine.
        allow_unsigned: Allow an unsigned link to reach beyond this machine.
        admits: Tells from a datagram of an unknown sender whether `udpin` takes it for its peer.

    Raises:
        EndpointError: The URL is malformed, its scheme is unknown, its port is in use, nobody
            listens, the device does not exist, or an unsigned link reaches beyond this machine.
    """
    endpoint = parse_endpoint(url)
    if endpoint.scheme == "serial":
        return SerialPort(endpoint)
    if endpoint.scheme == "fd":
        return StreamTransport(endpoint.inherited_socket(), url)
    opened = endpoint.open_socket(beyond=signed or allow_unsigned)
    if opened.type == socket.SOCK_DGRAM:
        return UdpTransport(opened, url, admits if endpoint.scheme == "udpin" else None)
    if endpoint.scheme == "tcp":
        return StreamTransport(opened, url)
    return FirstClient(TcpListener(opened, url))


def open_listener(
    url: str,
    *,
    signed: bool = False,
    allow_unsigned: bool = False,
    admits: Callable[[bytes], bool] = begins_with_frame,
) -> Listener:
    """Open an endpoint that serves several peers.

    Args:
        url, signed, allow_unsigned: As in `open_transport`.
        admits: Tells from the first datagram of an unknown sender whether it becomes a peer.

    Raises:
        EndpointError: As in `open_transport`.
    """
    endpoint = parse_endpoint(url)
    if endpoint.scheme == "fd":
        return _OnePeer(StreamTransport(endpoint.inherited_socket(), url, patient=False))
    if endpoint.scheme not in LISTENING:
        return _OnePeer(open_transport(url, signed=signed, allow_unsigned=allow_unsigned))
    opened = endpoint.open_socket(beyond=signed or allow_unsigned)
    if endpoint.scheme == "udpin":
        return UdpListener(opened, url, admits)
    return TcpListener(opened, url)


class _OnePeer:
    """Listener for an endpoint with exactly one peer, which exists from the start."""

    def __init__(self, transport: Transport) -> None:
        self._fresh = [transport]
        self.fileno, self.close = transport.fileno, transport.close

    def accept_ready(self) -> list[Transport]:
        fresh, self._fresh = self._fresh, []
        return fresh


# In memory ----------------------------------------------------------------------------------------


def memory_pair(url: str) -> tuple[_MemoryTransport, _MemoryTransport]:
    """Return both ends of a new link in memory; error messages name it by its URL."""
    ours, theirs = _MemoryTransport(url), _MemoryTransport(url)
    ours._peer, theirs._peer = theirs, ours
    return ours, theirs


class _MemoryTransport:
    """One end of a link in memory; made in pairs by `memory_pair`.

    Nobody else runs while one end waits. So an end that has nothing to receive first has its
    `on_wait` called, in which the other end can act, and never sleeps.
    """

    datagram = False
    address = rival_address = ""

    def __init__(self, url: str) -> None:
        self.url = url
        self.on_wait: Callable[[], None] = lambda: None
        self._peer: _MemoryTransport | None = None  # None once either end has closed
        self._arrived: list[bytes] = []

    def send(self, data: bytes) -> None:
        if self._peer is None:
            raise LinkLost(f"{self.url}: the peer closed the connection")
        self._peer._arrived.append(data)

    def receive(self, timeout_s: float) -> bytes:
        if not self._arrived and self._peer is not None:
            self.on_wait()
        if not self._arrived and self._peer is None:
            raise LinkLost(f"{self.url}: the peer closed the connection")
        data = b"".join(self._arrived)
        self._arrived.clear()
        return data

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        if self._peer is not None:
            self._peer._peer = None
            self._peer = None
