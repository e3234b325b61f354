"""Passes MAVLink frames between an autopilot and the programs of a companion, byte for byte.

Every frame from one side reaches the other side. Frames from a program also reach the companion's
other programs, as on a real autopilot's link. The owner may replace frames in transit. A program on
a UDP port gets every frame until it has been silent for 30 s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from functools import partial
from typing import Any

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Codec, Message, Signing, frame_of
from mavfi_cli.link.peers import Peer, Peers
from mavfi_cli.link.transport import Transport


class Side(Enum):
    """The side of the router from which a frame comes."""

    AUTOPILOT = "autopilot"
    COMPANION = "companion"


Pass = Callable[[Message, Side], Iterable[bytes]]
"""A function that decides which frames to forward in place of a received message.

It takes the message and its side, and returns the message's own frame, other frames or none.
"""


class _Program(Peer):
    """The autopilot, or one program of the companion."""

    def __init__(self, transport: Transport, *, router: Router, side: Side) -> None:
        super().__init__(transport)
        self.side, self._router = side, router
        self._codec = Codec(0, 0, signing=router.signing, keeps_unknown=True)

    def take(self, data: bytes) -> list[Message]:
        messages = self._codec.decode(data, datagram=self.transport.datagram)
        for message in messages:
            self._router.receive(message, self)
        return messages


class Router:
    """Forwards frames between one autopilot and one companion.

    Args:
        autopilot: URL or open transport of the autopilot.
        companion: URL of the companion's link, to which several programs can connect if it listens,
            or an open transport to a single program.
        passes: Decides which frames to pass on; None passes every frame.
        signing: Rejects frames without a valid signature, on both sides.
        allow_unsigned: Allow addresses other than loopback without signing.

    Attributes:
        port: Local port of the companion's link if that listens. For port 0 the system chooses one.
        sender: Peer whose message `passes` is called with; None outside that call.

    Raises:
        LinkError: A link cannot be opened.
    """

    def __init__(
        self,
        autopilot: str | Transport,
        companion: str | Transport,
        *,
        passes: Pass | None = None,
        signing: Signing | None = None,
        allow_unsigned: bool = False,
    ) -> None:
        self.signing = signing
        self._passes = passes or (lambda message, _side: (frame_of(message),))
        self.peers: Peers[_Program] = Peers(signing=signing, allow_unsigned=allow_unsigned)
        self.sender: Peer | None = None
        self._senders: dict[tuple[int, int], _Program] = {}  # newest, by system and component
        make = partial(_Program, router=self)
        self.peers.open(autopilot, partial(make, side=Side.AUTOPILOT))
        listener = self.peers.open(companion, partial(make, side=Side.COMPANION))
        self.port = int(getattr(companion, "port", getattr(listener, "port", 0)))

    def turn(self, timeout_s: float, until_s: float) -> None:
        """Wait for frames, then pass on those that have arrived.

        Args:
            timeout_s: Longest wait for the first frame, s.
            until_s: Monotonic time after which remaining frames wait for the next turn.

        Raises:
            LinkLost: The other end closed a link that does not listen.
        """
        self.peers.wait(timeout_s)
        self.peers.serve(until_s)
        if self.peers.lost is not None:
            raise self.peers.lost
        if self.peers.over:
            raise LinkLost("the autopilot closed the connection")

    def receive(self, message: Message, sender: _Program) -> None:
        """Forward the frames that `passes` returns for a received message."""
        self._senders[message.get_srcSystem(), message.get_srcComponent()] = sender
        self.sender = sender
        frames = [*self._passes(message, sender.side)]
        self.sender = None
        for frame in frames:
            self.send(frame, sender.side, sender)

    def send_late(self, frame: bytes, side: Side, message: Message) -> None:
        """Send a frame in place of a message that was held back, except to the message's sender."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        self.send(frame, side, self._senders.get(sender))

    def send(self, frame: bytes, side: Side, sender: Any = None) -> None:
        """Send a frame to every peer that gets the frames of `side`, except to `sender`."""

        def forward(peer: _Program) -> None:
            if peer is not sender and not side is peer.side is Side.AUTOPILOT:
                peer.transport.send(frame)

        self.peers.for_all(forward)

    def close(self) -> None:
        """Close both links."""
        self.peers.close()
