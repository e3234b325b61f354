"""The camera's links: every frame of a peer goes to all others, as in a MAVLink router."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Codec, Signing, begins_with_frame
from mavfi_cli.link.endpoint import LISTENING, parse_endpoint
from mavfi_cli.link.transport import Listener, Transport, open_listener
from sitl.camera.component import COMPONENT_ID

SILENCE_S = 30.0  # time after which a UDP sender that says nothing valid is forgotten


@dataclass(frozen=True, slots=True, kw_only=True)
class _Door:
    """An endpoint and what its scheme means for its peers."""

    listener: Listener
    scheme: str


@dataclass(slots=True, kw_only=True)
class _Peer:
    link: Transport
    codec: Codec  # of what it sends
    door: _Door
    heard_s: float
    spoke: bool = False

    @property
    def awaits_frames(self) -> bool:
        """True unless it is a companion that has started the camera and is not ready yet."""
        return self.spoke or self.door.scheme != "fd"


class Router:
    """Joins the peers of several endpoints, and is the camera component among them.

    A sender on a listening endpoint is a peer after its first valid frame.

    Args:
        urls: Endpoints to open. The autopilot may be on any of them.
        signing: Signs what the camera sends and refuses frames without a good signature. Frames
            of others keep their own signatures.
        allow_unsigned: Allow unsigned links beyond this machine.
        clock: Monotonic clock in seconds.

    Attributes:
        over: True once an inherited connection has closed.

    Raises:
        EndpointError: An endpoint cannot be opened.
    """

    def __init__(
        self,
        urls: Sequence[str],
        *,
        signing: Signing | None = None,
        allow_unsigned: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.over = False
        self._signing, self._clock = signing, clock
        self._codec = Codec(1, COMPONENT_ID, signing=signing)
        self._doors: list[_Door] = []
        self._peers: list[_Peer] = []
        admits = begins_with_frame if signing is None else signing.vouches
        try:
            for url in urls:
                listener = open_listener(
                    url, signed=signing is not None, allow_unsigned=allow_unsigned, admits=admits
                )
                self._doors.append(_Door(listener=listener, scheme=parse_endpoint(url).scheme))
            self._welcome()
        except BaseException:
            self.close()
            raise

    @property
    def system(self) -> int:
        """MAVLink system id of the camera."""
        return self._codec.system

    @system.setter
    def system(self, system: int) -> None:
        self._codec.system = system

    def wait(self, timeout_s: float) -> None:
        """Wait until a peer says something, or until the time is over."""
        with selectors.DefaultSelector() as selector:
            descriptors = {door.listener.fileno() for door in self._doors}
            descriptors |= {peer.link.fileno() for peer in self._peers}
            for descriptor in descriptors:
                if descriptor >= 0:  # a door with one peer closes with it
                    selector.register(descriptor, selectors.EVENT_READ)
            selector.select(timeout_s)

    def serve(self, take: Callable[[Any], bool]) -> None:
        """Handle all waiting messages.

        Args:
            take: Handles a message. Returns True if it goes to the other peers, too.

        Raises:
            LinkLost: The peer of an endpoint that does not listen closed it.
        """
        self._welcome()
        for peer in list(self._peers):
            while data := self._try(peer, partial(peer.link.receive, 0.0)):
                for message in peer.codec.decode(data, datagram=peer.link.datagram):
                    peer.heard_s, peer.spoke = self._clock(), True
                    if take(message):
                        self._forward(message, peer)
        self._forget_silent()

    def send(self, messages: Sequence[Any]) -> None:
        """Send messages of the camera to all peers. Raises as `serve`."""
        data = b"".join(self._codec.encode(message) for message in messages)
        for peer in list(self._peers) if data else ():
            self._try(peer, partial(peer.link.send, data))

    def close(self) -> None:
        """Close every link."""
        for peer in self._peers:
            peer.link.close()
        for door in self._doors:
            door.listener.close()

    def _forward(self, message: Any, source: _Peer) -> None:
        frame = bytes(message.get_msgbuf())
        for peer in list(self._peers):
            if peer is not source and peer.awaits_frames:
                self._try(peer, partial(peer.link.send, frame))

    def _welcome(self) -> None:
        for door in self._doors:
            for link in door.listener.accept_ready():
                codec = Codec(0, 0, signing=self._signing)
                self._peers.append(_Peer(link=link, codec=codec, door=door, heard_s=self._clock()))

    def _forget_silent(self) -> None:
        since_s = self._clock() - SILENCE_S
        for peer in list(self._peers):
            if peer.door.scheme == "udpin" and peer.heard_s < since_s:
                self._remove(peer)

    def _try(self, peer: _Peer, action: Callable[[], bytes | None]) -> bytes | None:
        try:
            return action()
        except LinkLost:
            self._remove(peer)
            if peer.door.scheme not in (*LISTENING, "fd"):
                raise
            self.over = self.over or peer.door.scheme == "fd"
            return None

    def _remove(self, peer: _Peer) -> None:
        peer.link.close()
        if peer in self._peers:
            self._peers.remove(peer)
