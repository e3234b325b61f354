"""How outcome, time and path vary over repeated fault-free flights of a user's companion.

Such a flight is not repeatable, so every effect of a fault must be compared with this spread.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.core.files import plain
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_to_end
from mavfi_cli.mission.run_folder import Run
from mavfi_cli.mission.success import FlownPath
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.shares import wilson


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """How much the outcome, flight time and path of repeated flights of one mission vary.

    Attributes:
        outcomes: Number of flights by outcome.
        succeeded: Success rate, and the ends of its 95 % interval (Wilson).
        flight_time_s: Smallest, median and largest time of a successful flight, s.
        apart_m: Largest distance between the path of each later successful flight and that of the
            first one, m: median and maximum over these flights.
    """

    outcomes: dict[str, int]
    succeeded: tuple[float, float, float]
    flight_time_s: tuple[float, float, float]
    apart_m: tuple[float, float]

    @classmethod
    def of(cls, runs: Sequence[Run]) -> Spread:
        """Compare repeated flights. A number is NaN if no flight provides it."""
        good = [run for run in runs if run.record.succeeded]
        share = wilson(len(good), len(runs))
        qualities = [run.record.quality_of_flight for run in good]
        times = sorted(own.flight_time_s for own in qualities if own.flight_time_s is not None)
        paths = [FlownPath.of(run.folder.path) for run in good]
        apart = [paths[0].apart_m(path) for path in paths[1:]]
        return cls(
            outcomes=dict(Counter(run.record.outcome for run in runs)),
            succeeded=(share.share, share.low, share.high),
            flight_time_s=(_at(times, 0.0), _at(times, 0.5), _at(times, 1.0)),
            apart_m=(_at(sorted(apart), 0.5), _at(sorted(apart), 1.0)),
        )

    def lines(self) -> list[str]:
        """Return lines of text on the outcomes, the flight times and the paths."""
        total = sum(self.outcomes.values())
        share, low, high = (100.0 * value for value in self.succeeded)
        flown = ", ".join(f"{name} {count}" for name, count in sorted(self.outcomes.items()))
        least, median, most = self.flight_time_s
        lines = [
            f"Outcomes    {flown}, of {total}: success {share:.1f} % ({low:.1f} to {high:.1f})"
        ]
        if not math.isnan(median):
            lines.append(f"Time        {median:.2f} s median, {least:.2f} to {most:.2f} s")
        if not math.isnan(self.apart_m[0]):
            lines.append(
                f"Path        {self.apart_m[0]:.2f} m median, {self.apart_m[1]:.2f} m largest "
                "distance from the first flight"
            )
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Return the attributes as plain values, with None in place of NaN."""
        return dict(plain(asdict(self)))


def fly_spread(config: MissionConfig, count: int, out: Path, watcher: Watcher) -> Spread:
    """Fly the golden run of a mission `count` times, one after the other, and compare the flights.

    Raises:
        Interrupted: The user interrupted the flights.
        MavfiError: As for `fly_mission`.
    """
    runs = []
    for number in range(1, count + 1):
        runs.append(fly_to_end(config.golden, out))
        watcher.on_note(f"flight {number} of {count}: {runs[-1].record.outcome}")
    return Spread.of(runs)


def _at(values: Sequence[float], share: float) -> float:
    """Return the quantile `share` of sorted values, or NaN if there are none.

    If the quantile lies between two values, the upper one is returned.
    """
    return values[min(int(share * len(values)), len(values) - 1)] if values else math.nan
