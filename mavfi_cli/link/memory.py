"""A link in memory: both of its ends live in one process, and only bytes pass between them."""

from __future__ import annotations

from collections.abc import Callable

from mavfi_cli.core.errors import LinkLost


class MemoryTransport:
    """One end of a link in memory; made in pairs by `memory_pair`.

    Nobody else runs while one end waits. So an end that has nothing to receive first has its
    `on_wait` called, in which the other end can act, and never sleeps.

    Attributes:
        on_wait: called when `receive` finds nothing, before it returns.
    """

    datagram = False

    def __init__(self, url: str) -> None:
        self.url = url
        self.on_wait: Callable[[], None] = lambda: None
        self._peer: MemoryTransport | None = None  # None once either end has closed
        self._arrived: list[bytes] = []

    def send(self, data: bytes) -> None:
        """Send whole frames; see `Transport`."""
        if self._peer is None:
            raise LinkLost(f"{self.url}: the peer closed the connection")
        self._peer._arrived.append(data)

    def receive(self, timeout_s: float) -> bytes:
        """Everything that has arrived, or b"" at once whatever `timeout_s`; see `Transport`."""
        if not self._arrived and self._peer is not None:
            self.on_wait()
        if not self._arrived and self._peer is None:
            raise LinkLost(f"{self.url}: the peer closed the connection")
        data = b"".join(self._arrived)
        self._arrived.clear()
        return data

    def fileno(self) -> int:
        """-1: no descriptor becomes readable."""
        return -1

    def close(self) -> None:
        """Part from the peer; harmless when repeated."""
        if self._peer is not None:
            self._peer._peer = None
            self._peer = None


def memory_pair(url: str) -> tuple[MemoryTransport, MemoryTransport]:
    """Both ends of a new link; messages to people name it by its URL."""
    ours, theirs = MemoryTransport(url), MemoryTransport(url)
    ours._peer, theirs._peer = theirs, ours
    return ours, theirs
