"""A link that records every frame of both directions in a tlog."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from mavfi_cli.link.codec import Codec, Message
from mavfi_cli.link.tlog import TlogWriter
from mavfi_cli.link.transport import Transport


class RecordedLink:
    """One end of a link with a tlog of its traffic.

    Traffic before `recording` is buffered and written first.

    Args:
        transport: Open transport. Its opener closes it.
        system, component: MAVLink ids of this end.
    """

    def __init__(self, transport: Transport, system: int, component: int) -> None:
        self._transport = transport
        self._codec = Codec(system, component)
        self._tlog: TlogWriter | None = None
        self._early: list[tuple[float, bytes]] = []

    @contextlib.contextmanager
    def recording(self, path: Path) -> Iterator[None]:
        """Write the tlog during the context.

        Raises:
            RecordError: The file cannot be written, now or at any later message.
        """
        with TlogWriter(path) as self._tlog:
            for stamp_s, frame in self._early:
                self._tlog.write(stamp_s, frame)
            self._early.clear()
            yield

    def receive(self, timeout_s: float) -> bytes:
        """Return the next bytes, or b"" after `timeout_s`.

        Raises:
            LinkLost: The other end closed the connection.
        """
        return self._transport.receive(timeout_s)

    def messages(self, data: bytes, stamp_s: float) -> Iterator[Message]:
        """Yield the messages in received bytes. Each is recorded at the stamp after its use."""
        for message in self._codec.decode(data, datagram=self._transport.datagram):
            yield message
            self._record(stamp_s, message.get_msgbuf())

    def send(self, messages: Sequence[Message], stamp_s: float) -> None:
        """Send the messages in this order and record them at the stamp.

        Raises:
            LinkLost: The other end closed the connection.
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
