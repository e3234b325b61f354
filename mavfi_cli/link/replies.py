"""Standard messages of a MAVLink node: HEARTBEAT, replies to TIMESYNC and PING, STATUSTEXT."""

from __future__ import annotations

import math

from mavfi_cli.link.codec import Message, dialect
from mavfi_cli.link.texts import text_messages

HEARTBEAT_INTERVAL_S = 1.0
_MAX_ANSWERS = 64  # maximum replies per tick; further requests are ignored


class Replies:
    """Collects replies until `take` returns them at the next tick."""

    def __init__(self) -> None:
        self._answers: list[Message] = []
        self._next_heartbeat_s = -math.inf
        self._texts = 0

    def handle(self, message: Message, now_s: float) -> None:
        """Handle a message. Replies to our own requests need no reply."""
        if len(self._answers) >= _MAX_ANSWERS:
            return
        if _asks_time(message):
            own_ns = round(now_s * 1e9)
            self._answers.append(dialect.MAVLink_timesync_message(own_ns, message.ts1))
        elif _pings(message):
            asker = (message.get_srcSystem(), message.get_srcComponent())
            self._answers.append(
                dialect.MAVLink_ping_message(message.time_usec, message.seq, *asker)
            )

    def announce(self, severity: int, text: str) -> None:
        """Broadcast a STATUSTEXT, mainly for ground stations."""
        self._texts = self._texts % 0xFFFF + 1
        self._answers += text_messages(severity, text.encode("ascii", "replace"), self._texts)

    def take(self, stamp_s: float) -> list[Message]:
        """Return the collected replies and texts, and our own HEARTBEAT once a second."""
        out, self._answers = self._answers, []
        if stamp_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = stamp_s + HEARTBEAT_INTERVAL_S
            out.append(_heartbeat())
        return out


def _asks_time(message: Message) -> bool:
    return isinstance(message, dialect.MAVLink_timesync_message) and message.tc1 == 0


def _pings(message: Message) -> bool:
    asked = isinstance(message, dialect.MAVLink_ping_message)
    return asked and message.target_system == message.target_component == 0


def _heartbeat() -> Message:
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0,
        dialect.MAV_STATE_ACTIVE, 3,
    )  # fmt: skip
