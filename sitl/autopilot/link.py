"""One client of the autopilot with its streams and pending messages."""

from __future__ import annotations

from collections import deque
from typing import Any

from sitl.autopilot.streams import Preset, Streams


class Link:
    """The autopilot's end of one connection, without a socket.

    Attributes:
        streams: Telemetry streams of this client.
        outbox: Pending messages, oldest first.
        parameters_left: Indices of parameters still to be listed.
    """

    __slots__ = ("outbox", "parameters_left", "streams")

    def __init__(self, preset: Preset) -> None:
        self.streams = Streams(preset)
        self.outbox: list[Any] = []
        self.parameters_left: deque[int] = deque()

    def send(self, message: Any) -> None:
        """Queue a message for this client."""
        self.outbox.append(message)
