"""Transports over UDP: one peer, or every admitted sender of a port."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from typing import Any

from mavfi_cli.link.codec import Codec, frame_length
from mavfi_cli.link.endpoint import CHUNK, MAX_PEERS, SMALL_CHUNK, Receiver, SocketOwner, text_of
from mavfi_cli.link.sender_slot import SenderSlot, is_of_autopilot

MAX_WAITING = 128  # maximum unread datagrams per peer; the oldest are dropped first
_JUDGED = 16  # datagrams of unknown senders that one pass examines; further ones are lost
_PUMPED = 1000  # datagrams that one pass reads
_MTU_PAYLOAD = 1400  # maximum bytes per datagram when frames are combined


class UdpTransport(SocketOwner, Receiver):
    """A UDP socket with one peer.

    A connected socket receives from that peer only. Any other takes the first admitted sender, and
    another one in its place after some silence. Before the first one, everything it sends is lost.

    Args:
        admits: Tells from its datagram whether a sender becomes the peer; None: it is connected.
    """

    datagram = True

    def __init__(
        self, opened: socket.socket, url: str, admits: Callable[[bytes], bool] | None
    ) -> None:
        super().__init__(opened, url)
        self._admits = admits
        self._slot: SenderSlot[Any] = SenderSlot()

    @property
    def rival_address(self) -> str:
        """See `Transport`."""
        return text_of(self._slot.rival)

    def send(self, data: bytes) -> None:
        """See `Transport`."""
        if self._slot.holder is not None or self._admits is None:
            _send_datagrams(self._socket, data, self._slot.holder)

    def _pull(self) -> bytes:
        for _ in range(_PUMPED):
            data, sender = _receive_datagram(self._socket, CHUNK)
            if sender is None or self._admits is None or self._is_peer(data, sender):
                return data
        return b""

    def _is_peer(self, data: bytes, sender: Any) -> bool:
        assert self._admits is not None
        if self._slot.hears(sender):
            return True
        if not self._admits(data):
            return False
        if self._slot.is_free:
            self._slot.take(sender)
            self.address = text_of(sender)
            return True
        if any(map(is_of_autopilot, Codec(0, 0).decode(data, datagram=True))):
            self._slot.challenge(sender)
        return False


def _receive_datagram(opened: socket.socket, limit: int) -> tuple[bytes, Any]:
    """Return a datagram, up to a number of bytes, and its sender; b"" and None without one.

    ECONNREFUSED means that nobody listens at the other end of a connected socket. It is not an
    error for UDP, because the peer may start later.
    """
    try:
        return opened.recvfrom(limit)
    except OSError:
        return b"", None


def _send_datagrams(opened: socket.socket, data: bytes, peer: Any) -> None:
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


def _split_frames(data: bytes) -> list[bytes]:
    """Combine well-formed frames into datagrams that fit an Ethernet packet."""
    if len(data) <= _MTU_PAYLOAD:
        return [data]
    datagrams, start, position = [], 0, 0
    while position < len(data):
        length = frame_length(data, position, len(data))
        if position > start and position + length - start > _MTU_PAYLOAD:
            datagrams.append(data[start:position])
            start = position
        position += length
    datagrams.append(data[start:])
    return datagrams


class UdpListener(SocketOwner):
    """A port on which every admitted sender becomes a peer. All peers share one socket.

    There are at most MAX_PEERS, and while one of them is open nobody else takes its place.
    """

    def __init__(self, opened: socket.socket, url: str, admits: Callable[[bytes], bool]) -> None:
        super().__init__(opened, url)
        self._admits = admits
        self.peers: dict[Any, _UdpPeer] = {}  # by address
        self._fresh: list[_UdpPeer] = []

    def accept_ready(self) -> list[_UdpPeer]:
        """See `Listener`."""
        self.pump()
        fresh, self._fresh = [peer for peer in self._fresh if not peer.lost], []
        return fresh

    def pump(self) -> None:
        """Distribute the waiting datagrams to their peers."""
        judged = 0
        for _ in range(_PUMPED):
            data, sender = _receive_datagram(self._socket, SMALL_CHUNK)
            if sender is None:
                return
            peer = self.peers.get(sender)
            if peer is None:
                if judged == _JUDGED or len(self.peers) >= MAX_PEERS:
                    continue
                judged += 1
                if not self._admits(data):
                    continue
                peer = self.peers[sender] = _UdpPeer(self, sender)
                self._fresh.append(peer)
            peer.waiting.append(data)

    def send_to(self, data: bytes, address: Any) -> None:
        """Send frames to one peer's address."""
        _send_datagrams(self._socket, data, address)

    def close(self) -> None:
        """See `Listener`."""
        for peer in self.peers.values():
            peer.lost = True
        super().close()


class _UdpPeer(Receiver):
    datagram = True

    def __init__(self, listener: UdpListener, address: Any) -> None:
        self._listener = listener
        self._address = address
        self.address = text_of(address)
        self.url = listener.url
        self.waiting: deque[bytes] = deque(maxlen=MAX_WAITING)
        self.lost = False

    def send(self, data: bytes) -> None:
        if self.lost:
            self._lost("this peer was dropped")
        self._listener.send_to(data, self._address)

    def _pull(self) -> bytes:
        if not self.waiting:
            if self.lost:
                self._lost("this peer was dropped")
            self._listener.pump()
        return self.waiting.popleft() if self.waiting else b""

    def fileno(self) -> int:
        return self._listener.fileno()

    def close(self) -> None:
        self.lost = True
        self._listener.peers.pop(self._address, None)
