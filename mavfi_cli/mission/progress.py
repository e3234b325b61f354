"""What a mission tells while it flies. The watcher here listens to nothing: a null object."""

from __future__ import annotations

from dataclasses import dataclass

from mavfi_cli.mission.record.events import Event


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """The state of the flight, told once a simulated second."""

    stamp_s: float
    phase: str
    speed_mps: float
    goal_distance_m: float | None
    replans: int


class Watcher:
    """Gets progress and events; override what is of interest."""

    def on_progress(self, progress: Progress) -> None:
        """Called once a simulated second."""

    def on_note(self, text: str) -> None:
        """Called before something that takes long and is no part of the flight."""

    def on_event(self, event: Event) -> None:
        """Called for every event as it happens."""
