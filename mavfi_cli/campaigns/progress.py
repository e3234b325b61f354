"""Progress of a campaign, and the interface of its observers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """The state of a running campaign at one moment.

    Attributes:
        total: number of missions on the list.
        before: missions that were finished before this run began.
        over: missions that are finished now, including `before`.
        running: flights that have not ended; missions that share a flight count as one.
        again: attempts that were repeated because something outside the mission ended them or may
            have affected them.
        elapsed_s: wall time of this run, in seconds.
        inside_s: wall time spent in missions, summed over the workers, in seconds.
        workers: missions that can fly at the same time; None if that varies, as on a cluster.
        outcomes: outcomes of this run's missions by setting, in the order of the list.
        beyond_s: estimated wall time of the work that follows the missions, in seconds.
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
        """Missions finished per hour in this run so far, or 0 before the first has ended."""
        return 3600.0 * (self.over - self.before) / self.elapsed_s if self.elapsed_s > 0.0 else 0.0

    @property
    def eta_s(self) -> float | None:
        """Remaining wall time at this rate, in seconds, or None before a mission has ended."""
        rate = self.rate_per_h
        return 3600.0 * (self.total - self.over) / rate + self.beyond_s if rate > 0.0 else None

    @property
    def outside(self) -> float | None:
        """Fraction of the workers' time spent outside missions, or None if their number varies."""
        if self.workers is None or self.elapsed_s <= 0.0:
            return None
        return max(0.0, 1.0 - self.inside_s / (self.workers * self.elapsed_s))

    @property
    def success_rate(self) -> float | None:
        """Success rate of this run's missions, or None before the first has ended."""
        whole = sum(self.outcomes.values(), Counter())
        return whole["success"] / whole.total() if whole else None

    @property
    def success_rates(self) -> dict[str, float]:
        """Success rate of each setting in which this run has finished a mission."""
        return {
            setting: outcomes["success"] / outcomes.total()
            for setting, outcomes in self.outcomes.items()
            if outcomes
        }


def duration(seconds: float) -> str:
    """Format a duration in seconds as `M:SS min`, or as `H:MM:SS h` from one hour."""
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{left:02d} h" if hours else f"{minutes}:{left:02d} min"


class Spectator:
    """Observes a campaign while it runs. This base class ignores all events."""

    def on_progress(self, progress: Progress) -> None:
        """Handle the current progress. Called after missions end, and at least every second."""

    def on_end(self, progress: Progress) -> None:
        """Handle the end of the run: all missions have ended, or the user interrupted it."""

    def on_note(self, text: str) -> None:
        """Handle a message for the user, such as why an attempt at a mission is repeated."""

    def on_step(self, text: str, elapsed_s: float) -> None:
        """Handle the progress of work that is not a mission, such as runs of isolated kernels.

        Args:
            text: the progress in one line.
            elapsed_s: wall time since this work began, in seconds.
        """
