"""Serves the peers at several endpoints in turn, receiving and sending in bounded time.

A client of a TCP port becomes a peer when it connects, a sender to a UDP port with its first valid
frame. `open_listener` bounds the number of peers and their waiting bytes. The source address of a
datagram may be forged; replies then reach a host that has sent nothing. A peer on a UDP port
therefore gets all messages of `send_in_turn` only for a short time after a valid frame, and then
fewer and fewer. It is removed after 30 s of silence.
"""

from __future__ import annotations

import math
import select
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Generic, TypeVar

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Signing, begins_with_frame
from mavfi_cli.link.endpoint import LISTENING, parse_endpoint
from mavfi_cli.link.transport import Listener, Transport, open_listener

_SILENCE_S = 30.0
# Time for which a UDP peer gets all messages, after its first valid frame and after later ones.
_AFTER_FIRST_S, _AFTER_LATER_S = 0.2, 3.0


class Peer(ABC):
    """The program at the other end of a transport. `Peers` sets the attributes.

    Attributes:
        scheme: Scheme of the URL of the endpoint to which the peer belongs.
        last_received_s, last_sent_s: Times of the newest valid frame from it and of the newest
            message to it.
        full_rate_s: Time after a valid frame for which a UDP peer gets all messages, s.
    """

    scheme = ""
    last_received_s = last_sent_s = 0.0
    full_rate_s = _AFTER_FIRST_S

    def __init__(self, transport: Transport) -> None:
        self.transport = transport

    @abstractmethod
    def take(self, data: bytes) -> Sequence[object]:
        """Handle received bytes. Return the valid messages among them."""

    def forward(self, *, frame: bytes, sender: Peer) -> bool:
        """Send the frame of another peer to this peer, unchanged.

        Return False, without sending, if this peer is the `sender`.
        """
        if sender is self:
            return False
        self.transport.send(frame)
        return True

    def close(self) -> None:
        """Release the connection."""
        self.transport.close()


P = TypeVar("P", bound=Peer)
T = TypeVar("T")


class Peers(Generic[P]):
    """The peers of all open endpoints, which are served in turn.

    Args:
        signing: Verifies the first frame of a sender; None accepts any valid frame.
    """

    def __init__(
        self,
        *,
        signing: Signing | None = None,
        allow_unsigned: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._signing, self._allow_unsigned, self._clock = signing, allow_unsigned, clock
        self._endpoints: list[tuple[str, Listener, Callable[[Transport], P]]] = []
        self._peers: list[P] = []
        self._receive_turn = self._send_turn = 0  # index of the peer served last
        self.over = False  # True once an inherited connection has closed
        self.lost: LinkLost | None = None  # loss of the only peer of an endpoint that connects

    def __iter__(self) -> Iterator[P]:
        """Iterate over a copy of the list of peers, so that peers may leave meanwhile."""
        return iter(list(self._peers))

    def open(self, endpoint: str | Transport, make: Callable[[Transport], P]) -> Listener:
        """Open an endpoint, and return its listener. An error closes all endpoints.

        Args:
            endpoint: URL, or an open transport.
            make: Makes a peer from each transport of the endpoint.

        Raises LinkError if it cannot be opened.
        """
        signing = self._signing
        url = endpoint if isinstance(endpoint, str) else endpoint.url
        try:
            listener = open_listener(
                endpoint, signed=signing is not None, allow_unsigned=self._allow_unsigned,
                admits=begins_with_frame if signing is None else signing.authenticates,
            )  # fmt: skip
        except BaseException:
            self.close()
            raise
        self._endpoints.append((parse_endpoint(url).scheme, listener, make))
        return listener

    def wait(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` seconds until bytes or a new connection arrive."""
        poller = select.poll()
        descriptors = {listener.fileno() for _, listener, _ in self._endpoints}
        for descriptor in descriptors | {peer.transport.fileno() for peer in self._peers}:
            if descriptor >= 0:  # an endpoint with a single peer closes with it
                poller.register(descriptor, select.POLLIN)
        poller.poll(timeout_s * 1e3)

    def serve(self, until_s: float) -> None:
        """Accept new peers, then receive from all peers in turn.

        Receiving ends when no peer has data, or at the time `until_s` of the clock. Then silent
        peers on UDP ports are removed.
        """
        self._accept()
        idle = 0
        while idle < len(self._peers) and self._clock() < until_s:
            self._receive_turn = (self._receive_turn + 1) % len(self._peers)
            idle = 0 if self._receive(self._peers[self._receive_turn]) else idle + 1
        since_s = self._clock() - _SILENCE_S
        for peer in self:
            if peer.scheme == "udpin" and peer.last_received_s < since_s:
                self._remove(peer)

    def for_all(self, action: Callable[[P], object]) -> None:
        """Call `action` with every peer, and remove the peers whose connection is lost."""
        for peer in self:
            self._call(action, peer)

    def send_in_turn(self, action: Callable[[P], object], until_s: float = math.inf) -> None:
        """Call `action`, which sends to a peer, for each peer in turn.

        A silent UDP peer is called less and less often: the interval doubles each time. The peers
        that remain at `until_s` come first in the next call. The action must return False if it had
        nothing to send.
        """
        for _ in range(len(self._peers)):
            if not self._peers:
                break
            self._send_turn = (self._send_turn + 1) % len(self._peers)
            peer, now_s = self._peers[self._send_turn], self._clock()
            if _is_due(peer, now_s) and self._call(action, peer) is not False:
                peer.last_sent_s = now_s
            if self._clock() >= until_s:
                break

    def close(self) -> None:
        """Close every peer and endpoint."""
        for peer in self._peers:
            peer.close()
        for _, listener, _ in self._endpoints:
            listener.close()

    def _accept(self) -> None:
        fresh = []
        for scheme, listener, make in self._endpoints:
            for transport in listener.accept_ready():
                peer = make(transport)
                peer.scheme = scheme
                peer.last_received_s = peer.last_sent_s = self._clock()
                fresh.append(peer)
        self._peers += fresh
        for peer in fresh:
            self._receive(peer)  # at once; else another sender could replay its signed frame
            peer.full_rate_s = _AFTER_FIRST_S

    def _receive(self, peer: P) -> bool:
        """Handle some of a peer's waiting bytes. Return True if there were any."""
        data = self._call(lambda peer: peer.transport.receive(0.0), peer)
        if data and self._call(lambda peer: peer.take(data), peer):
            peer.last_received_s, peer.full_rate_s = self._clock(), _AFTER_LATER_S
        return bool(data)

    def _call(self, action: Callable[[P], T], peer: P) -> T | None:
        """Return `action(peer)`. If the peer has disconnected, remove it and return None."""
        try:
            return action(peer)
        except LinkLost as error:
            self._remove(peer)
            if peer.scheme == "fd":
                self.over = True
            elif peer.scheme not in LISTENING:
                self.lost = error
            return None

    def _remove(self, peer: P) -> None:
        peer.close()
        if peer in self._peers:
            self._peers.remove(peer)


def _is_due(peer: Peer, now_s: float) -> bool:
    """Return True if a peer may be sent a message now.

    A silent UDP peer may not if a message was sent to it in the last half of its silence.
    """
    silent_s, unsent_s = now_s - peer.last_received_s, now_s - peer.last_sent_s
    return peer.scheme != "udpin" or silent_s <= max(peer.full_rate_s, 2.0 * unsent_s)
