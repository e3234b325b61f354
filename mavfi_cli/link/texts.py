"""STATUSTEXT: splits texts into chunks and joins them.

Source: https://mavlink.io/en/messages/common.html#STATUSTEXT. A text longer than 50 characters
comes in chunks with a common id. The last chunk is shorter than 50 characters.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from mavfi_cli.link.codec import Message, dialect

CHUNK_LENGTH = 50
_MAX_OPEN = 16
_MAX_TEXTS = 1000
_PATIENCE_S = 1.0  # maximum wait for missing chunks
_GAP = "[...]"


def text_messages(severity: int, data: bytes, text_id: int) -> Iterator[Any]:
    """Yield the STATUSTEXT messages of one text.

    A text that fits into one message has id 0. A longer text is sent in chunks with `text_id`.
    Its last chunk is shorter than CHUNK_LENGTH bytes.

    Args:
        severity: MAV_SEVERITY, 0 emergency .. 7 debug.
        data: Text in ASCII.
        text_id: Id of the text, 1 .. 65535.
    """
    if len(data) <= CHUNK_LENGTH:
        yield dialect.MAVLink_statustext_message(severity, data)
        return
    for number, start in enumerate(range(0, len(data) + 1, CHUNK_LENGTH)):
        chunk = data[start : start + CHUNK_LENGTH]
        yield dialect.MAVLink_statustext_message(severity, chunk, text_id, number)


@dataclass(frozen=True, slots=True, kw_only=True)
class Text:
    """A complete text of a component."""

    stamp_s: float  # arrival of its last chunk
    severity: int  # MAV_SEVERITY, 0 emergency .. 7 debug
    text: str


@dataclass(slots=True, kw_only=True)
class _Open:
    severity: int
    started_s: float
    chunks: dict[int, str]


class TextCollector:
    """Collects texts.

    Attributes:
        texts: The newest thousand.
        total: Number of all.
        open: Texts whose chunks have not all come, by system, component and id.
    """

    def __init__(self) -> None:
        self.texts: deque[Text] = deque(maxlen=_MAX_TEXTS)
        self.total = 0
        self.open: dict[tuple[int, int, int], _Open] = {}

    def since(self, total: int) -> list[Text]:
        """Return the texts received since `total` had this value."""
        if total == self.total:
            return []
        fresh = min(self.total - total, len(self.texts))
        return list(self.texts)[len(self.texts) - fresh :]

    def add(self, message: Message, stamp_s: float) -> list[Text]:
        """Handle a STATUSTEXT. Return the texts that are complete now."""
        if message.id == 0:
            return [self._emit(stamp_s, message.severity, message.text)]
        done = []
        key = (message.get_srcSystem(), message.get_srcComponent(), message.id)
        if key not in self.open:
            if len(self.open) >= _MAX_OPEN:
                done.append(self._finish(next(iter(self.open)), stamp_s))
            self.open[key] = _Open(severity=message.severity, started_s=stamp_s, chunks={})
        chunks = self.open[key].chunks
        chunks[message.chunk_seq] = message.text
        last = max(chunks)
        if len(chunks[last]) < CHUNK_LENGTH and len(chunks) == last + 1:
            done.append(self._finish(key, stamp_s))
        return done

    def expire(self, stamp_s: float, patience_s: float = _PATIENCE_S) -> list[Text]:
        """Close and return texts with chunks missing for longer than the patience, with a gap."""
        late = [k for k, o in self.open.items() if stamp_s - o.started_s >= patience_s]
        return [self._finish(key, stamp_s) for key in late]

    def _finish(self, key: tuple[int, int, int], stamp_s: float) -> Text:
        part = self.open.pop(key)
        last = max(part.chunks)
        text = "".join(part.chunks.get(index, _GAP) for index in range(last + 1))
        if len(part.chunks[last]) >= CHUNK_LENGTH:
            text += _GAP
        return self._emit(stamp_s, part.severity, text)

    def _emit(self, stamp_s: float, severity: int, text: str) -> Text:
        self.total += 1
        self.texts.append(Text(stamp_s=stamp_s, severity=severity, text=text.strip()))
        return self.texts[-1]
