"""Event log of a mission."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One event of a flight."""

    stamp_s: float
    kind: str  # phase, autopilot, plan, collision, outcome
    text: str
    position_enu_m: tuple[float, float, float] | None = None


class EventListener(Protocol):
    """Receiver of events."""

    def on_event(self, event: Event) -> None:
        """Handle an event."""


@dataclass(slots=True)
class EventLog:
    """Collects events and passes them on."""

    listener: EventListener
    events: list[Event] = field(default_factory=list)

    def add(
        self,
        stamp_s: float,
        kind: str,
        text: str,
        position_enu_m: tuple[float, float, float] | None = None,
    ) -> None:
        """Add an event."""
        event = Event(stamp_s=stamp_s, kind=kind, text=text, position_enu_m=position_enu_m)
        self.events.append(event)
        self.listener.on_event(event)

    def to_list(self) -> list[dict[str, Any]]:
        """Return plain values for the record of the run."""
        return [asdict(event) for event in self.events]
