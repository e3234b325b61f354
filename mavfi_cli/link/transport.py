"""Transports: bytes to and from one peer, opened by URL.

Which class serves which URL is decided here; how each works is in `streams`, `datagrams` and
`serial_port`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from mavfi_cli.core.errors import EndpointError, LinkLost
from mavfi_cli.link.endpoint import Endpoint, Scheme, check_reach, parse_endpoint, resolve

__all__ = [
    "EndpointError",
    "LinkLost",
    "Listener",
    "Transport",
    "open_listener",
    "open_transport",
]


class Transport(Protocol):
    """Bytes to and from one peer."""

    @property
    def url(self) -> str:
        """What it was opened by, for messages to people."""

    @property
    def datagram(self) -> bool:
        """Whether every `receive` returns whole frames (pass it on to `Codec.decode`)."""

    def send(self, data: bytes) -> None:
        """Send whole frames. A datagram may get lost without a word; LinkLost on a closed peer."""

    def receive(self, timeout_s: float) -> bytes:
        """The next bytes, waiting at most `timeout_s` (inf: for ever); b"" when none came.

        Raises:
            LinkLost: the peer closed the connection, or the device went away.
        """

    def fileno(self) -> int:
        """The descriptor that becomes readable when `receive` would return something; -1: none."""

    def close(self) -> None:
        """Release the socket or device; harmless when repeated."""


class Listener(Protocol):
    """Finds the peers of one URL: each client of a listening one, the only peer of any other."""

    @property
    def url(self) -> str:
        """What it was opened by, for messages to people."""

    def accept_ready(self) -> Sequence[Transport]:
        """The peers that appeared since the last call; does not wait."""

    def fileno(self) -> int:
        """The descriptor that becomes readable when `accept_ready` may return something."""

    def close(self) -> None:
        """Stop listening; UDP peers, which share the socket, end with it."""


def open_transport(url: str, *, signed: bool = False, allow_unsigned: bool = False) -> Transport:
    """Open one end of a link.

    Args:
        url: `udpin:[host]:port`, `udpout:host:port`, `tcp:host:port`, `tcpin:[host]:port`,
            `serial:device[:baud]` or `fd:number`; without a host it listens on loopback.
        signed: the caller signs this link, so that it may reach beyond this machine.
        allow_unsigned: let an unsigned link reach beyond this machine all the same.

    Raises:
        EndpointError: malformed URL, unknown scheme, port in use, nobody there, no such device,
            or an unsigned link beyond this machine.
    """
    # The scheme's module is imported on use, to keep the import of this one cheap.
    endpoint = parse_endpoint(url)
    if endpoint.scheme is Scheme.SERIAL:
        from mavfi_cli.link.serial_port import SerialPort

        return SerialPort(endpoint)
    if endpoint.scheme in (Scheme.UDP_IN, Scheme.UDP_OUT):
        from mavfi_cli.link import datagrams

        opened = datagrams.bound if endpoint.scheme is Scheme.UDP_IN else datagrams.connected
        return opened(endpoint, _reachable(endpoint, signed, allow_unsigned))
    from mavfi_cli.link import streams

    if endpoint.scheme is Scheme.FD:
        return streams.inherited(endpoint)
    address = _reachable(endpoint, signed, allow_unsigned)
    if endpoint.scheme is Scheme.TCP:
        return streams.connected(endpoint, address)
    return streams.TcpServerEnd(streams.TcpListener(endpoint, address))


def open_listener(url: str, *, signed: bool = False, allow_unsigned: bool = False) -> Listener:
    """Open an endpoint that serves several peers; arguments and errors as `open_transport`."""
    endpoint = parse_endpoint(url)
    if endpoint.scheme is Scheme.UDP_IN:
        from mavfi_cli.link.datagrams import UdpListener

        return UdpListener(endpoint, _reachable(endpoint, signed, allow_unsigned))
    if endpoint.scheme is Scheme.TCP_IN:
        from mavfi_cli.link.streams import TcpListener

        return TcpListener(endpoint, _reachable(endpoint, signed, allow_unsigned))
    return _OnePeer(open_transport(url, signed=signed, allow_unsigned=allow_unsigned))


def _reachable(endpoint: Endpoint, signed: bool, allow_unsigned: bool) -> tuple[int, str]:
    import socket

    datagram = endpoint.scheme in (Scheme.UDP_IN, Scheme.UDP_OUT)
    kind = socket.SOCK_DGRAM if datagram else socket.SOCK_STREAM
    family, address = resolve(endpoint, kind)
    check_reach(endpoint, address, signed=signed, allow_unsigned=allow_unsigned)
    return family, address


class _OnePeer:
    """A listener on an endpoint that has exactly one peer, there from the start."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._fresh = [transport]
        self.url = transport.url

    def accept_ready(self) -> list[Transport]:
        """The peer, the first time; nobody after."""
        fresh, self._fresh = self._fresh, []
        return fresh

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._transport.fileno()

    def close(self) -> None:
        """Release it; harmless when repeated."""
        self._transport.close()
