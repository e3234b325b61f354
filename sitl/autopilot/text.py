"""STATUSTEXT in PX4's form: a trailing TAB, and chunks of 50 bytes with one id."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from typing import Any

from mavfi_cli.link import texts


class Severity(IntEnum):
    """Used levels of MAV_SEVERITY."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6


def text_messages(severity: int, text: str, text_id: int) -> Iterator[Any]:
    """Yield the STATUSTEXT messages of one text.

    The TAB tells clients of the events interface that the same text arrives there, too.
    """
    yield from texts.text_messages(severity, text.encode("ascii", "replace") + b"\t", text_id)
