"""The clock of a foreign vehicle, which is heard only in the stamps of its states."""

from __future__ import annotations

import time
from collections.abc import Callable

_MEASURED_S = 1.0  # wall time after which the pace is known


class ForeignClock:
    """Time of a foreign vehicle and of the wall since its newest state.

    Between two states the vehicle's clock is estimated. It runs at the pace that the flight has had
    so far, but no faster than the wall's clock: a simulator may be slower than real time.

    Args:
        wall: Clock of the wall, s.

    Attributes:
        stamp_s: Stamp of the newest state; 0 before the first.
        heard: True once a state has arrived.
    """

    def __init__(self, wall: Callable[[], float] = time.monotonic) -> None:
        self._wall = wall
        self._first = (0.0, 0.0)  # stamp and wall time of the first state
        self._waited_s = 0.0
        self._pace = 1.0
        self.stamp_s = 0.0
        self.heard = False

    def hear(self, stamp_s: float) -> None:
        """Note a new state."""
        now_s = self._wall()
        if not self.heard or stamp_s < self.stamp_s:
            self.heard, self._first, self._pace = True, (stamp_s, now_s), 1.0
        self.stamp_s, self._waited_s = stamp_s, 0.0
        flown_s, passed_s = stamp_s - self._first[0], now_s - self._first[1]
        if passed_s >= _MEASURED_S:
            self._pace = min(1.0, flown_s / passed_s)

    def wait(self, waited_s: float) -> None:
        """Note a time on the wall's clock without a new state."""
        self._waited_s += waited_s

    @property
    def silence_s(self) -> float:
        """Time without a new state that has passed on the vehicle's clock and on the wall's."""
        return self._waited_s * self._pace

    @property
    def now_s(self) -> float:
        """Estimate of the vehicle's time."""
        return self.stamp_s + self.silence_s
