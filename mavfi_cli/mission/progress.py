"""Progress reports of a mission in flight. The base class `Watcher` ignores them."""

from __future__ import annotations

from dataclasses import dataclass

from mavfi_cli.mission.record.events import Event


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightProgress:
    """State of the flight, reported once per simulated second."""

    stamp_s: float
    phase: str
    speed_mps: float
    goal_distance_m: float | None
    replans: int


class Watcher:
    """Receives progress and events. Subclasses override the methods of interest."""

    def on_progress(self, progress: FlightProgress) -> None:
        """Handle a progress report, once per simulated second."""

    def on_note(self, text: str) -> None:
        """Handle the announcement of a long operation that is not part of the flight."""

    def on_event(self, event: Event) -> None:
        """Handle an event."""
