"""The camera's links: every message of a peer goes to all others, as in a MAVLink router.

Frames of messages that the `common` dialect lacks are dropped, as their checksums are unknown.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from mavfi_cli.link.codec import Codec, Signing, dialect
from mavfi_cli.link.endpoint import parse_endpoint
from mavfi_cli.link.sender_slot import SenderSlot, is_of_autopilot, two_autopilots
from mavfi_cli.link.texts import text_messages
from mavfi_cli.link.transport import Transport
from sitl.camera.component import COMPONENT_ID
from sitl.peers import Peer, Peers

_TURN_S = 0.02  # time for the messages of all peers, after which the camera acts
_TEXT_ID = 2  # of the texts about two autopilots; the referee's have another


class _Linked(Peer):
    """An autopilot, companion or ground station on one of the links.

    Args:
        transport: Its connection.
        router: Hears its messages.
        slots: Place of the autopilot of each system at the peer's endpoint.
        awaits_frames: False for a companion that has started the camera, until it speaks.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        router: Router,
        slots: dict[int, SenderSlot[_Linked]],
        awaits_frames: bool,
    ) -> None:
        super().__init__(transport)
        self.slots, self.awaits_frames, self._router = slots, awaits_frames, router
        self._codec = Codec(0, 0, signing=router.signing)

    def take(self, data: bytes) -> list[Any]:
        """Handle received bytes. Return the messages in them."""
        messages = self._codec.decode(data, datagram=self.transport.datagram)
        self.awaits_frames = self.awaits_frames or bool(messages)
        for message in messages:
            self._router.hear(message, self)
        return messages

    def forward(self, *, frame: bytes, of: Peer) -> None:
        """See `Peer`."""
        if self.awaits_frames:
            super().forward(frame=frame, of=of)

    def close(self) -> None:
        """Close the connection and leave every place."""
        super().close()
        for slot in self.slots.values():
            slot.leave(self)


class Router:
    """Joins the peers of several endpoints, and is the camera component among them.

    Two autopilots of the same system id at one endpoint would be one vehicle that jumps. The frames
    of the second are dropped, and a STATUSTEXT tells both senders.

    Args:
        urls: Endpoints to open. The autopilot may be on any of them.
        signing: Signs what the camera sends and refuses frames without a good signature. Frames
            of others keep their own signatures.
        allow_unsigned: Allow unsigned links beyond this machine.
        clock: Monotonic clock in seconds.

    Attributes:
        codec: Encoder of the camera's messages.
        peers: Everybody on the links.
        take: Handles a message. Returns True if it goes to the other peers, too.

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
        self.signing, self._clock = signing, clock
        self.codec = Codec(1, COMPONENT_ID, signing=signing)
        self.take: Callable[[Any], bool] = lambda _message: True
        self.peers: Peers[_Linked] = Peers(
            signing=signing, allow_unsigned=allow_unsigned, clock=clock
        )
        for url in urls:
            waits = parse_endpoint(url).scheme != "fd"
            self.peers.open(url, partial(_Linked, router=self, slots={}, awaits_frames=waits))

    def serve(self) -> None:
        """Handle waiting messages, for a bounded time.

        Raises:
            LinkLost: The peer of an endpoint that does not listen closed it.
        """
        self.peers.serve(self._clock() + _TURN_S)
        if self.peers.lost is not None:
            raise self.peers.lost

    def hear(self, message: Any, source: _Linked) -> None:
        """Handle a message of a peer, and pass it on."""
        if self._is_of_holder(message, source) and self.take(message):
            frame = bytes(message.get_msgbuf())
            self.peers.each(partial(_Linked.forward, frame=frame, of=source))

    def _is_of_holder(self, message: Any, source: _Linked) -> bool:
        """Return False for the frame of a second autopilot."""
        if not is_of_autopilot(message):
            return True
        slot = source.slots.setdefault(message.get_srcSystem(), SenderSlot(self._clock))
        if slot.hears(source):
            self._tell_rival(slot)
        elif slot.is_free:
            slot.take(source)
        else:
            if isinstance(message, dialect.MAVLink_heartbeat_message):  # once a second
                slot.challenge(source)
            return False
        return True

    def _tell_rival(self, slot: SenderSlot[_Linked]) -> None:
        """Send the addresses of two autopilots, if both speak."""
        if slot.holder is None or slot.rival is None:
            return
        text = two_autopilots(slot.holder.transport.address, slot.rival.transport.address)
        slot.rival = None
        severity = dialect.MAV_SEVERITY_CRITICAL
        self.send(list(text_messages(severity, text.encode(), _TEXT_ID)))

    def send(self, messages: Sequence[Any]) -> None:
        """Send messages of the camera to all peers."""
        if data := b"".join(self.codec.encode(message) for message in messages):
            self.peers.each(lambda peer: peer.transport.send(data))

    def close(self) -> None:
        """Close every link."""
        self.peers.close()
