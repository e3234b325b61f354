"""Transports, opened by URL, that carry bytes to and from one peer.

This module chooses the class for a URL. `streams` and `datagrams` implement them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.endpoint import Endpoint, UrlScheme, check_reach, parse_endpoint, resolve


class Transport(Protocol):
    """Bytes to and from one peer."""

    @property
    def url(self) -> str:
        """URL of the endpoint, for error messages."""

    @property
    def datagram(self) -> bool:
        """True if every `receive` returns whole frames; an argument of `Codec.decode`."""

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

    @property
    def url(self) -> str:
        """URL of the endpoint, for error messages."""

    def accept_ready(self) -> Sequence[Transport]:
        """Return the peers that appeared since the last call, without waiting."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when `accept_ready` may return peers."""

    def close(self) -> None:
        """Stop listening. This closes UDP peers, too, because they share the socket."""


def open_transport(url: str, *, signed: bool = False, allow_unsigned: bool = False) -> Transport:
    """Open one end of a link.

    Args:
        url: `udpin:[host]:port`, `udpout:host:port`, `tcp:host:port`, `tcpin:[host]:port`,
            `serial:device[:baud]` or `fd:number`; without a host it listens on loopback.
        signed: The caller signs this link, so it may reach beyond this machine.
        allow_unsigned: Allow an unsigned link to reach beyond this machine.

    Raises:
        EndpointError: The URL is malformed, its scheme is unknown, its port is in use, nobody
            listens, the device does not exist, or an unsigned link reaches beyond this machine.
    """
    # Each scheme's module is imported on first use to keep the import of this module cheap.
    endpoint = parse_endpoint(url)
    if endpoint.scheme is UrlScheme.SERIAL:
        from mavfi_cli.link.streams import SerialPort

        return SerialPort(endpoint)
    if endpoint.scheme in (UrlScheme.UDP_IN, UrlScheme.UDP_OUT):
        from mavfi_cli.link import datagrams

        opened = datagrams.bound if endpoint.scheme is UrlScheme.UDP_IN else datagrams.connected
        return opened(endpoint, _reachable(endpoint, signed, allow_unsigned))
    from mavfi_cli.link import streams

    if endpoint.scheme is UrlScheme.FD:
        return streams.inherited(endpoint)
    address = _reachable(endpoint, signed, allow_unsigned)
    if endpoint.scheme is UrlScheme.TCP:
        return streams.connected(endpoint, address)
    return streams.TcpServerEnd(streams.TcpListener(endpoint, address))


def open_listener(url: str, *, signed: bool = False, allow_unsigned: bool = False) -> Listener:
    """Open an endpoint that serves several peers. Arguments and errors as in `open_transport`."""
    endpoint = parse_endpoint(url)
    if endpoint.scheme is UrlScheme.UDP_IN:
        from mavfi_cli.link.datagrams import UdpListener

        return UdpListener(endpoint, _reachable(endpoint, signed, allow_unsigned))
    if endpoint.scheme is UrlScheme.TCP_IN:
        from mavfi_cli.link.streams import TcpListener

        return TcpListener(endpoint, _reachable(endpoint, signed, allow_unsigned))
    return _OnePeer(open_transport(url, signed=signed, allow_unsigned=allow_unsigned))


def _reachable(endpoint: Endpoint, signed: bool, allow_unsigned: bool) -> tuple[int, str]:
    import socket

    datagram = endpoint.scheme in (UrlScheme.UDP_IN, UrlScheme.UDP_OUT)
    kind = socket.SOCK_DGRAM if datagram else socket.SOCK_STREAM
    family, address = resolve(endpoint, kind)
    check_reach(endpoint, address, signed=signed, allow_unsigned=allow_unsigned)
    return family, address


class _OnePeer:
    """Listener for an endpoint with exactly one peer, which exists from the start."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._fresh = [transport]
        self.url = transport.url

    def accept_ready(self) -> list[Transport]:
        """Return the peer on the first call, nothing afterwards."""
        fresh, self._fresh = self._fresh, []
        return fresh

    def fileno(self) -> int:
        return self._transport.fileno()

    def close(self) -> None:
        self._transport.close()


class _MemoryTransport:
    """One end of a link in memory; made in pairs by `memory_pair`.

    Nobody else runs while one end waits. So an end that has nothing to receive first has its
    `on_wait` called, in which the other end can act, and never sleeps.

    Attributes:
        on_wait: called when `receive` finds nothing, before it returns.
    """

    datagram = False

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


def memory_pair(url: str) -> tuple[_MemoryTransport, _MemoryTransport]:
    """Both ends of a new link; messages to people name it by its URL."""
    ours, theirs = _MemoryTransport(url), _MemoryTransport(url)
    ours._peer, theirs._peer = theirs, ours
    return ours, theirs
