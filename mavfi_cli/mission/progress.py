"""What a mission tells while it flies: to a `Watcher` its progress, to a `Recorder` its inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mavfi_cli.core.types import Briefing


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One event of a flight."""

    stamp_s: float
    kind: str  # phase, autopilot, plan, collision, outcome
    text: str
    position_enu_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightProgress:
    """State of the flight, reported once per simulated second."""

    stamp_s: float
    phase: str
    speed_mps: float
    goal_distance_m: float | None
    replans: int


class Watcher:
    """Receives progress and events. The base class ignores them."""

    def on_progress(self, progress: FlightProgress) -> None:
        """Handle a progress report, once per simulated second."""

    def on_note(self, text: str) -> None:
        """Handle the announcement of a long operation that is not part of the flight."""

    def on_event(self, event: Event) -> None:
        """Handle an event."""


class Recorder:
    """Records the briefing, and input and start stamp of every invocation by node."""

    def __init__(self) -> None:
        self.briefing: Briefing | None = None
        self.orders: dict[str, list[tuple[Any, float]]] = {}

    def on_start(self, node: str, value: Any, start_s: float) -> None:
        """Record the start of an invocation."""
        self.orders.setdefault(node, []).append((value, start_s))
