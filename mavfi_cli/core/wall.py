"""Measures the host's wall-clock time, which only the `host` section of a record contains."""

from __future__ import annotations

import contextlib
from time import perf_counter

EVERY = 7  # ticks; coprime to the periods of camera and telemetry, so no phase is preferred


class WallClock:
    """Measures how much wall-clock time the named parts of a flight take on the host.

    A stage that runs in every tick is sampled: it is measured in every seventh tick, which counts
    sevenfold. Measuring every tick would take a twentieth of a flight's wall time.

    Attributes:
        skipped_s: time, in seconds, that no measurement includes, because the whole flight waited.
        totals: total time of each part in seconds, keyed by its name.
        newest: newest measurement of each part in seconds, keyed by its name.
    """

    def __init__(self) -> None:
        self.skipped_s = 0.0
        self.totals: dict[str, float] = {}
        self.newest: dict[str, float] = {}
        self._ticks = 0

    def begin_tick(self) -> None:
        """Count one more tick, so that `sample` can tell which ticks to measure."""
        self._ticks += 1

    def sample(self, name: str) -> contextlib.AbstractContextManager[None]:
        """Return a context manager that measures its block in every seventh tick.

        It adds seven times the measured time to the total of `name`, and nothing in other ticks.
        """
        return _Measurement(self, name, EVERY) if self._ticks % EVERY == 0 else _UNMEASURED

    def measure(self, name: str) -> _Measurement:
        """Return a context manager that adds the time of its block to the total of `name`."""
        return _Measurement(self, name)

    def add(self, name: str, seconds: float) -> None:
        """Add host seconds that were measured elsewhere to the total of `name`."""
        self.totals[name] = self.totals.get(name, 0.0) + seconds
        self.newest[name] = seconds


_UNMEASURED = contextlib.nullcontext()


class _Measurement:
    """Context manager that adds the time of its block to a clock.

    A class is faster than a generator.

    Args:
        weight: factor by which the measured time is multiplied.
    """

    __slots__ = ("_begun", "_clock", "_name", "_weight")

    def __init__(self, clock: WallClock, name: str, weight: int = 1) -> None:
        self._clock, self._name, self._weight = clock, name, weight

    def __enter__(self) -> None:
        self._begun = perf_counter() - self._clock.skipped_s

    def __exit__(self, *_: object) -> None:
        clock = self._clock
        clock.add(self._name, self._weight * (perf_counter() - clock.skipped_s - self._begun))
