"""Keeps simulated time in step with the wall clock."""

from __future__ import annotations

import time

_PATIENCE_S = 0.5


class Pace:
    """Says how long to wait before the next tick.

    A machine that cannot keep up gets no bill for the past: beyond half a second of delay the
    lost time is forgiven.

    Args:
        speed: simulated seconds for each second of the wall clock.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._due_s = time.monotonic()

    def next_tick(self, tick_s: float) -> None:
        """One more tick has been simulated."""
        self._due_s = max(self._due_s + tick_s / self._speed, time.monotonic() - _PATIENCE_S)

    def remaining_s(self) -> float:
        """Until the tick is due; zero or less when it is."""
        return self._due_s - time.monotonic()
