"""STATUSTEXT as PX4 sends it: a trailing TAB, and chunks of 50 bytes under one id."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from typing import Any

from mavfi_cli.link import texts


class Severity(IntEnum):
    """MAV_SEVERITY, the levels in use."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6


def text_messages(severity: int, text: str, text_id: int) -> Iterator[Any]:
    """The STATUSTEXT messages of one text.

    The TAB tells clients which also take the events interface that the same words come there.
    """
    yield from texts.text_messages(severity, text.encode("ascii", "replace") + b"\t", text_id)
