"""Wall-clock time of the host. It enters only the record's `host` section, never the mission."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter


class WallClock:
    """Host seconds by name: the total and the newest measurement."""

    def __init__(self) -> None:
        self.totals: dict[str, float] = {}
        self.newest: dict[str, float] = {}

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the duration of the block to a name."""
        begun = perf_counter()
        try:
            yield
        finally:
            self.add(name, perf_counter() - begun)

    def add(self, name: str, seconds: float) -> None:
        """Add host seconds that were measured elsewhere."""
        self.totals[name] = self.totals.get(name, 0.0) + seconds
        self.newest[name] = seconds
