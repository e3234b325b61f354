"""The peers at several endpoints: who is heard and told, in which order, and for how long.

A sender on a listening endpoint becomes a peer with its first valid frame; `open_listener` bounds
their number and what waits for them. A sender's address may be false, and everything that is sent
then hits whoever has it. So a UDP peer is told everything only for a short while after each of its
valid frames, then less and less, and is forgotten after 30 s.
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
# Time after a valid frame for which a UDP peer is told everything: after its first one, and later.
_NEWCOMER_S, _LISTENER_S = 0.2, 3.0


class Peer(ABC):
    """Somebody at the other end of a transport.

    `Peers` keeps its scheme, when it was last heard and told, and for how long after it was heard
    it is told everything.
    """

    scheme = ""
    heard_s = told_s = 0.0
    listens_s = _NEWCOMER_S

    def __init__(self, transport: Transport) -> None:
        self.transport = transport

    @abstractmethod
    def take(self, data: bytes) -> Sequence[object]:
        """Handle received bytes. Return the valid messages among them."""

    def forward(self, *, frame: bytes, of: Peer) -> bool:
        """Send a frame of another peer unchanged. Return False for the peer's own."""
        if of is self:
            return False
        self.transport.send(frame)
        return True

    def close(self) -> None:
        """Release the connection."""
        self.transport.close()


P = TypeVar("P", bound=Peer)
T = TypeVar("T")


class Peers(Generic[P]):
    """All peers of all open endpoints.

    Args:
        signing: Vouches for unknown senders; None: everybody with a valid frame is welcome.
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
        self._turns = self._told = 0
        self.over = False  # True once an inherited connection has closed
        self.lost: LinkLost | None = None  # of the only peer of an endpoint that calls

    def __iter__(self) -> Iterator[P]:
        """Iterate over the present peers. They may leave meanwhile."""
        return iter(list(self._peers))

    def open(self, url: str, make: Callable[[Transport], P]) -> None:
        """Open an endpoint, whose transports `make` turns into peers; else close all.

        Raises LinkError if it cannot be opened.
        """
        signing = self._signing
        try:
            listener = open_listener(
                url, signed=signing is not None, allow_unsigned=self._allow_unsigned,
                admits=begins_with_frame if signing is None else signing.vouches,
            )  # fmt: skip
        except BaseException:
            self.close()
            raise
        self._endpoints.append((parse_endpoint(url).scheme, listener, make))

    def wait(self, timeout_s: float) -> None:
        """Wait until somebody says something, or until the time is over."""
        poller = select.poll()
        descriptors = {listener.fileno() for _, listener, _ in self._endpoints}
        for descriptor in descriptors | {peer.transport.fileno() for peer in self._peers}:
            if descriptor >= 0:  # an endpoint with a single peer closes with it
                poller.register(descriptor, select.POLLIN)
        poller.poll(timeout_s * 1e3)

    def serve(self, until_s: float) -> None:
        """Welcome new peers, and handle the bytes of all by turns until the time is over."""
        self._welcome()
        quiet = 0
        while quiet < len(self._peers) and self._clock() < until_s:
            self._turns = (self._turns + 1) % len(self._peers)
            quiet = 0 if self._hear(self._peers[self._turns]) else quiet + 1
        since_s = self._clock() - _SILENCE_S
        for peer in self:
            if peer.scheme == "udpin" and peer.heard_s < since_s:
                self._remove(peer)

    def each(self, action: Callable[[P], object]) -> None:
        """Call a function with every peer, and remove those whose connection is lost."""
        for peer in self:
            self._try(peer, action)

    def tell(self, action: Callable[[P], object], until_s: float = math.inf) -> None:
        """Call a function that sends with every peer by turns, except for a silent UDP peer.

        The intervals at which a silent one is told double. Once the time is over, the others have
        to wait for the next call, in which they are the first. The function returns False if there
        was nothing to send.
        """
        for _ in range(len(self._peers)):
            if not self._peers:
                break
            self._told = (self._told + 1) % len(self._peers)
            peer, now_s = self._peers[self._told], self._clock()
            silent_s, untold_s = now_s - peer.heard_s, now_s - peer.told_s
            is_due = peer.scheme != "udpin" or silent_s <= max(peer.listens_s, 2.0 * untold_s)
            if is_due and self._try(peer, action) is not False:
                peer.told_s = now_s
            if self._clock() >= until_s:
                break

    def close(self) -> None:
        """Close every peer and endpoint."""
        for peer in self._peers:
            peer.close()
        for _, listener, _ in self._endpoints:
            listener.close()

    def _welcome(self) -> None:
        for scheme, listener, make in self._endpoints:
            for transport in listener.accept_ready():
                peer = make(transport)
                peer.scheme, peer.heard_s = scheme, self._clock()
                peer.told_s = peer.heard_s
                self._peers.append(peer)
                self._hear(peer)  # else a copy of its signed frame would be as new
                peer.listens_s = _NEWCOMER_S

    def _hear(self, peer: P) -> bool:
        """Handle a few waiting bytes of a peer. Return True if there were any."""
        data = self._try(peer, lambda peer: peer.transport.receive(0.0))
        if data and self._try(peer, lambda peer: peer.take(data)):
            peer.heard_s, peer.listens_s = self._clock(), _LISTENER_S
        return bool(data)

    def _try(self, peer: P, action: Callable[[P], T]) -> T | None:
        """Call a function with a peer. Remove a disconnected one, and return None."""
        try:
            return action(peer)
        except LinkLost as error:
            self._remove(peer)
            self.over = self.over or peer.scheme == "fd"
            self.lost = self.lost if peer.scheme in (*LISTENING, "fd") else error
            return None

    def _remove(self, peer: P) -> None:
        peer.close()
        if peer in self._peers:
            self._peers.remove(peer)
