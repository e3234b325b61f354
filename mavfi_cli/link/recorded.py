"""A link of which every packet of both directions goes into the tlog."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from mavfi_cli.link.codec import Codec, Message
from mavfi_cli.link.tlog import TlogWriter
from mavfi_cli.link.transport import Transport


class RecordedLink:
    """One end of a link, and the record of what went through it.

    What passes before `recording` begins is kept and comes first in the file.

    Args:
        transport: already open; whoever opened it closes it.
        system, component: MAVLink's ids of this end.
    """

    def __init__(self, transport: Transport, system: int, component: int) -> None:
        self._transport = transport
        self._codec = Codec(system, component)
        self._tlog: TlogWriter | None = None
        self._early: list[tuple[float, bytes]] = []

    @contextlib.contextmanager
    def recording(self, path: Path) -> Iterator[None]:
        """Write the tlog meanwhile.

        Raises:
            RecordError: the file cannot be written (here, or when a message comes or goes).
        """
        with TlogWriter(path) as self._tlog:
            for stamp_s, frame in self._early:
                self._tlog.write(stamp_s, frame)
            self._early.clear()
            yield

    def receive(self, timeout_s: float) -> bytes:
        """Wait for bytes; none where none came in time.

        Raises:
            LinkLost: the other end closed the connection.
        """
        return self._transport.receive(timeout_s)

    def messages(self, data: bytes, stamp_s: float) -> Iterator[Message]:
        """The messages in received bytes, each recorded at the stamp after it was taken."""
        for message in self._codec.decode(data, datagram=self._transport.datagram):
            yield message
            self._record(stamp_s, message.get_msgbuf())

    def send(self, messages: Sequence[Message], stamp_s: float) -> None:
        """Send them in this order, recorded at the stamp.

        Raises:
            LinkLost: the other end closed the connection.
        """
        frames = [self._codec.encode(message) for message in messages]
        for frame in frames:
            self._record(stamp_s, frame)
        if self._transport.datagram:
            for frame in frames:
                self._transport.send(frame)
        elif frames:
            self._transport.send(b"".join(frames))

    def _record(self, stamp_s: float, frame: bytes) -> None:
        if self._tlog is None:
            self._early.append((stamp_s, frame))
        else:
            self._tlog.write(stamp_s, frame)
