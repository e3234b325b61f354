"""Wall-clock time of the host. Only the record's `host` section contains it, never the mission."""

from __future__ import annotations

from time import perf_counter


class WallClock:
    """Host seconds by name: the total and the newest measurement.

    Attributes:
        skipped_s: time that no measurement includes, because the whole flight waited.
    """

    def __init__(self) -> None:
        self.skipped_s = 0.0
        self.totals: dict[str, float] = {}
        self.newest: dict[str, float] = {}

    def measure(self, name: str) -> _Measurement:
        """Return a context that adds the time of its block to a name."""
        return _Measurement(self, name)

    def add(self, name: str, seconds: float) -> None:
        """Add host seconds that were measured elsewhere."""
        self.totals[name] = self.totals.get(name, 0.0) + seconds
        self.newest[name] = seconds


class _Measurement:
    """One timed block. A class is faster than a generator, and a tick times 20 blocks."""

    __slots__ = ("_begun", "_clock", "_name")

    def __init__(self, clock: WallClock, name: str) -> None:
        self._clock, self._name = clock, name

    def __enter__(self) -> None:
        self._begun = perf_counter() - self._clock.skipped_s

    def __exit__(self, *_: object) -> None:
        clock = self._clock
        clock.add(self._name, perf_counter() - clock.skipped_s - self._begun)
