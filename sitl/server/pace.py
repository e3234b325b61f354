"""Keeps simulated time in step with the wall clock."""

from __future__ import annotations

import time

_PATIENCE_S = 0.5


class Pace:
    """Computes the wait before the next tick.

    A slow machine does not accumulate delay: time lost beyond half a second of delay is
    dropped.

    Args:
        speed: simulated seconds for each second of the wall clock.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._due_s = time.monotonic()

    def next_tick(self, tick_s: float) -> None:
        """Count one more simulated tick."""
        self._due_s = max(self._due_s + tick_s / self._speed, time.monotonic() - _PATIENCE_S)

    def remaining_s(self) -> float:
        """Time until the tick is due; zero or less if it is."""
        return self._due_s - time.monotonic()
