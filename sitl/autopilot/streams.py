"""Telemetry streams: messages of each link and their rates."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from mavfi_cli.core.config import read_toml
from mavfi_cli.link.codec import dialect
from sitl.autopilot.telemetry import BUILDERS, Builder, Snapshot

TICK_US = 20_000  # period of the control loop
STEPS_A_TICK = 5
STEP_US = TICK_US // STEPS_A_TICK  # step of the physics, the shortest interval of any stream
_OUTBOX = 500  # messages that wait for a client; the oldest are dropped first


class Preset(Enum):
    """Set of default rates of a link, in `streams.toml`."""

    ONBOARD = "onboard"  # PX4 v1.17's link to a companion
    GCS = "gcs"  # PX4 v1.17's link to a ground station
    LOCKSTEP = "lockstep"  # only the messages that a companion in lockstep needs


_RATES_HZ, _ = read_toml(Path(__file__).with_suffix(".toml"))


class _Stream:
    __slots__ = ("build", "due_us", "interval_us")

    def __init__(self, build: Builder, interval_us: int) -> None:
        self.build = build
        self.interval_us = interval_us  # 0: not streamed
        self.due_us = 0


class Link:
    """The autopilot's end of one connection, without a socket, and its telemetry streams.

    Args:
        preset: Default rates of the client.

    Attributes:
        in_lockstep: Simulated time stands still while the client thinks.
        outbox: Pending messages, oldest first.
        parameters_left: Indices of parameters still to be listed.
    """

    def __init__(self, preset: Preset) -> None:
        self.in_lockstep = preset is Preset.LOCKSTEP
        self.outbox: list[Any] = []
        self.parameters_left: deque[int] = deque()
        self._rates_hz: Mapping[str, float] = _RATES_HZ[preset.value]
        self._streams = {
            number: _Stream(build, self._default_us(number)) for number, build in BUILDERS.items()
        }
        self._active: tuple[_Stream, ...] = ()
        self._fast: tuple[_Stream, ...] = ()
        self._choose_active()

    def send(self, message: Any) -> None:
        """Queue a message for this client."""
        if len(self.outbox) >= _OUTBOX:
            del self.outbox[0]
        self.outbox.append(message)

    def interval_us(self, message_id: int) -> int | None:
        """Return the interval of a message; 0 if it is not streamed, None if unknown."""
        stream = self._streams.get(message_id)
        return None if stream is None else stream.interval_us

    def set_interval(self, message_id: int, interval_us: float, stamp_us: int) -> bool:
        """Set an interval: negative stops, 0 restores the default. Return False if unknown."""
        stream = self._streams.get(message_id)
        if stream is None:
            return False
        if interval_us < 0:
            stream.interval_us = 0
        elif interval_us == 0:
            stream.interval_us = self._default_us(message_id)
        else:
            shortest_us = TICK_US if self.in_lockstep else STEP_US
            stream.interval_us = int(min(max(interval_us, shortest_us), 3.6e9))
        stream.due_us = stamp_us
        self._choose_active()
        return True

    def hasten(self, message_id: int, stamp_us: int) -> None:
        """Make a streamed message due now, because its contents have changed."""
        self._streams[message_id].due_us = stamp_us

    @property
    def is_fast(self) -> bool:
        """True if a stream has an interval below a tick."""
        return bool(self._fast)

    def due(self, stamp_us: int, snapshot: Snapshot) -> list[Any]:
        """Return the messages due at a tick. A late stream skips missed messages."""
        return self._due(self._active, stamp_us, snapshot)

    def due_between(self, stamp_us: int, snapshot: Snapshot) -> list[Any]:
        """Return the messages of fast streams due at a stamp between two ticks."""
        return self._due(self._fast, stamp_us, snapshot)

    def _due(self, streams: Sequence[_Stream], stamp_us: int, snapshot: Snapshot) -> list[Any]:
        messages = []
        for stream in streams:
            if stream.due_us > stamp_us:
                continue
            stream.due_us += stream.interval_us
            if stream.due_us <= stamp_us:
                stream.due_us = stamp_us + stream.interval_us
            message = stream.build(snapshot)
            if message is not None:
                messages.append(message)
        return messages

    def _default_us(self, message_id: int) -> int:
        rate_hz = self._rates_hz.get(dialect.mavlink_map[message_id].msgname, 0.0)
        return round(1e6 / rate_hz) if rate_hz else 0

    def _choose_active(self) -> None:
        self._active = tuple(s for s in self._streams.values() if s.interval_us)
        self._fast = tuple(s for s in self._active if s.interval_us < TICK_US)
