"""Progress of a campaign, for its spectators."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """A campaign at one moment of host time.

    Attributes:
        total: missions of the list.
        before: missions that were over before this run began.
        over: missions that are over now, including `before`.
        running: missions in flight.
        again: attempts that something outside ended and that were repeated.
        elapsed_s: wall time of this run, s.
        inside_s: wall time within missions, summed over the workers, s.
        workers: missions that can fly at the same time; None where that changes, as on a cluster.
        outcomes: of the missions that this run flew, by setting, in the order of the list.
        beyond_s: wall time of what follows the missions, s.
    """

    total: int
    before: int
    over: int
    running: int
    again: int
    elapsed_s: float
    inside_s: float
    workers: int | None = None
    outcomes: Mapping[str, Counter[str]] = field(default_factory=dict)
    beyond_s: float = 0.0

    @property
    def rate_per_h(self) -> float:
        """Missions an hour of this run so far; 0 before the first is over."""
        return 3600.0 * (self.over - self.before) / self.elapsed_s if self.elapsed_s > 0.0 else 0.0

    @property
    def eta_s(self) -> float | None:
        """Time until all is over at this rate; None before the first mission is."""
        rate = self.rate_per_h
        return 3600.0 * (self.total - self.over) / rate + self.beyond_s if rate > 0.0 else None

    @property
    def outside(self) -> float | None:
        """Fraction of the workers' time outside missions; None if their number is not known."""
        if self.workers is None or self.elapsed_s <= 0.0:
            return None
        return max(0.0, 1.0 - self.inside_s / (self.workers * self.elapsed_s))

    @property
    def success_rate(self) -> float | None:
        """Share of successes among the missions that this run flew; None before the first."""
        whole = sum(self.outcomes.values(), Counter())
        return whole["success"] / whole.total() if whole else None

    @property
    def success_rates(self) -> dict[str, float]:
        """Success rate of each setting that has a finished mission."""
        return {
            setting: outcomes["success"] / outcomes.total()
            for setting, outcomes in self.outcomes.items()
            if outcomes
        }


def duration(seconds: float) -> str:
    """A time as minutes or hours."""
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{left:02d} h" if hours else f"{minutes}:{left:02d} min"


class Spectator:
    """Watches a campaign. This base class ignores all events."""

    def on_progress(self, progress: Progress) -> None:
        """Handle progress: a mission is over, or a second has passed."""

    def on_end(self, progress: Progress) -> None:
        """Handle the end: all missions are over, or the user asked to stop."""

    def on_note(self, text: str) -> None:
        """Handle a note for the user."""

    def on_step(self, text: str, elapsed_s: float) -> None:
        """Handle progress of what is not missions, as one line; wall time since its begin, s."""
