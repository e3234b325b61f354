"""UDP transports: a peer at a known address, the newest sender to a port, or all its senders."""

from __future__ import annotations

import socket
import time
from collections import deque
from typing import Any

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.endpoint import Endpoint, SocketOwner, bind, readable

MAX_PEERS = 64
MAX_WAITING = 4096  # maximum unread datagrams per peer; the oldest are dropped first
_MTU_PAYLOAD = 1400  # maximum bytes per datagram when frames are combined
_CHUNK = 1 << 16
_MARKERS = (0xFD, 0xFE)


def _split_frames(data: bytes) -> list[bytes]:
    """Combine well-formed frames into datagrams that fit an Ethernet packet."""
    if len(data) <= _MTU_PAYLOAD:
        return [data]
    datagrams, start, position = [], 0, 0
    while position < len(data):
        length = data[position + 1] + 8
        if data[position] == 0xFD:
            length += 4 + (13 if data[position + 2] & 1 else 0)
        if position > start and position + length - start > _MTU_PAYLOAD:
            datagrams.append(data[start:position])
            start = position
        position += length
    datagrams.append(data[start:])
    return datagrams


class _UdpTransport(SocketOwner):
    """A UDP socket with one peer.

    A connected socket receives from that peer only. A bound socket sends to the last sender of
    MAVLink. Before the first one, everything it sends is lost.
    """

    datagram = True

    def __init__(self, opened: socket.socket, url: str, *, peer: Any = None) -> None:
        super().__init__(opened, url)
        self._peer = peer
        self._follow = peer is None

    def send(self, data: bytes) -> None:
        if self._peer is not None:
            _send(self._socket, data, self._peer if self._follow else None)

    def receive(self, timeout_s: float) -> bytes:
        data = self._pull()
        if not data and timeout_s > 0 and readable(self._socket.fileno(), timeout_s):
            data = self._pull()
        return data

    def _pull(self) -> bytes:
        """Return the next datagram, or b"" if none is waiting."""
        received = _receive(self._socket)
        if received is None:
            return b""
        data, sender = received
        if self._follow and data[:1] and data[0] in _MARKERS:
            self._peer = sender
        return data


def _receive(opened: socket.socket) -> tuple[bytes, Any] | None:
    """Return a datagram and its sender, or None if there is none.

    ECONNREFUSED means that nobody listens at the other end of a connected socket. It is not an
    error for UDP, because the peer may start later.
    """
    try:
        return opened.recvfrom(_CHUNK)
    except OSError:
        return None


def _send(opened: socket.socket, data: bytes, peer: Any) -> None:
    """Send to `peer`, or to the connected address. Data that cannot be sent is lost."""
    for datagram in _split_frames(data):
        for _attempt in range(2):  # the first may report the refusal of an earlier datagram
            try:
                if peer is None:
                    opened.send(datagram)
                else:
                    opened.sendto(datagram, peer)
                break
            except OSError:
                continue


def bound(endpoint: Endpoint, where: tuple[int, str]) -> _UdpTransport:
    """Open a transport that waits for its peer on a port.

    Raises:
        EndpointError: The port is in use.
    """
    return _UdpTransport(_bound_socket(endpoint, where), endpoint.url)


def connected(endpoint: Endpoint, where: tuple[int, str]) -> _UdpTransport:
    """Open a transport to the endpoint, resolved to family and address `where`."""
    family, address = where
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.connect((address, endpoint.port))
    return _UdpTransport(opened, endpoint.url, peer=(address, endpoint.port))


def _bound_socket(endpoint: Endpoint, where: tuple[int, str]) -> socket.socket:
    family, address = where
    opened = socket.socket(family, socket.SOCK_DGRAM)
    bind(opened, endpoint, address)
    return opened


class UdpListener(SocketOwner):
    """A port on which every sender of MAVLink becomes a peer. All peers share one socket.

    There are at most MAX_PEERS. A further peer replaces the one that has been silent longest.

    Raises:
        EndpointError: The port is in use, or the address is not this machine's.
    """

    def __init__(self, endpoint: Endpoint, where: tuple[int, str]) -> None:
        super().__init__(_bound_socket(endpoint, where), endpoint.url)
        self._peers: dict[Any, _UdpPeer] = {}  # the one silent longest comes first
        self._fresh: list[_UdpPeer] = []

    def accept_ready(self) -> list[_UdpPeer]:
        """Return the peers that appeared since the last call."""
        self.pump()
        fresh, self._fresh = [peer for peer in self._fresh if not peer.lost], []
        return fresh

    def pump(self) -> None:
        """Distribute all waiting datagrams to their peers."""
        for _ in range(MAX_WAITING):
            received = _receive(self._socket)
            if received is None:
                return
            data, sender = received
            peer = self._peers.pop(sender, None)
            if peer is None:
                if not data[:1] or data[0] not in _MARKERS:
                    continue
                peer = self._welcome(sender)
            self._peers[sender] = peer
            peer.waiting.append(data)

    def _welcome(self, sender: Any) -> _UdpPeer:
        if len(self._peers) >= MAX_PEERS:
            oldest = next(iter(self._peers))
            self._peers.pop(oldest).lost = True
        peer = _UdpPeer(self, sender)
        self._fresh.append(peer)
        return peer

    def send_to(self, data: bytes, address: Any) -> None:
        """Send frames to one peer's address."""
        _send(self._socket, data, address)

    def forget(self, address: Any) -> None:
        """Drop a peer. It counts as a new peer if it sends again."""
        self._peers.pop(address, None)

    def close(self) -> None:
        """Close it and its peers. May be called repeatedly."""
        for peer in self._peers.values():
            peer.lost = True
        super().close()


class _UdpPeer:
    datagram = True

    def __init__(self, listener: UdpListener, address: Any) -> None:
        self._listener = listener
        self._address = address
        self.url = listener.url
        self.waiting: deque[bytes] = deque(maxlen=MAX_WAITING)
        self.lost = False

    def send(self, data: bytes) -> None:
        if self.lost:
            raise LinkLost(f"{self.url}: this peer was dropped")
        self._listener.send_to(data, self._address)

    def receive(self, timeout_s: float) -> bytes:
        deadline_s = time.monotonic() + timeout_s if timeout_s > 0 else 0.0
        while not self.waiting:
            if self.lost:
                raise LinkLost(f"{self.url}: this peer was dropped")
            self._listener.pump()
            left_s = deadline_s - time.monotonic() if timeout_s > 0 else 0.0
            if self.waiting or left_s <= 0 or not readable(self.fileno(), left_s):
                break
        return self.waiting.popleft() if self.waiting else b""

    def fileno(self) -> int:
        return self._listener.fileno()

    def close(self) -> None:
        self.lost = True
        self._listener.forget(self._address)
