"""Periodic schedule by stamps."""

from __future__ import annotations

from dataclasses import dataclass

_SLACK_S = 1e-6  # tolerance, because stamps are sums of steps with rounding errors


@dataclass(slots=True, kw_only=True)
class PeriodicSchedule:
    """Due at the first poll and then every `interval_s` in phase with it.

    A late poll does not shift the phase. Missed times are skipped.
    """

    interval_s: float
    _first_s: float | None = None
    _count: int = 0

    def due(self, stamp_s: float) -> bool:
        """Return True if it is due at a stamp, and advance to the next time."""
        if self._first_s is None:
            self._first_s = stamp_s
        elapsed_s = stamp_s - self._first_s + _SLACK_S
        if elapsed_s < self._count * self.interval_s:
            return False
        self._count = int(elapsed_s / self.interval_s) + 1
        return True

    def restart(self) -> None:
        """Make it due at the next poll."""
        self._first_s, self._count = None, 0
