"""What is due when, by stamps alone."""

from __future__ import annotations

from dataclasses import dataclass

_SLACK_S = 1e-6  # stamps are sums of steps, and interval times count is not


@dataclass(slots=True, kw_only=True)
class Schedule:
    """Due at once, and then every `interval_s` in phase with the first time.

    A poll that comes late does not shift the phase, and what was missed is not made up for.
    """

    interval_s: float
    _first_s: float | None = None
    _count: int = 0

    def due(self, stamp_s: float) -> bool:
        """Whether it is due at a stamp; answering yes takes the turn."""
        if self._first_s is None:
            self._first_s = stamp_s
        elapsed_s = stamp_s - self._first_s + _SLACK_S
        if elapsed_s < self._count * self.interval_s:
            return False
        self._count = int(elapsed_s / self.interval_s) + 1
        return True

    def restart(self) -> None:
        """Due at the next stamp, whatever it is."""
        self._first_s, self._count = None, 0
