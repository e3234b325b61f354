"""STATUSTEXT as PX4 sends it: a trailing TAB, and chunks of 50 bytes under one id."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from typing import Any

from mavfi_cli.link.codec import dialect

_CHUNK = 50


class Severity(IntEnum):
    """MAV_SEVERITY, the levels in use."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6


def text_messages(severity: int, text: str, text_id: int) -> Iterator[Any]:
    """The STATUSTEXT messages of one text.

    A text that fits into one message has id 0. A longer one goes in chunks with `text_id`, and
    the chunk that ends it is shorter than 50 bytes. The TAB tells clients which also take the
    events interface that the same words come there.
    """
    data = text.encode("ascii", "replace") + b"\t"
    if len(data) <= _CHUNK:
        yield dialect.MAVLink_statustext_message(severity, data)
        return
    for number, start in enumerate(range(0, len(data) + 1, _CHUNK)):
        chunk = data[start : start + _CHUNK]
        yield dialect.MAVLink_statustext_message(severity, chunk, text_id, number)
