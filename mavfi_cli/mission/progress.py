"""Observers of a flight: a `Watcher` of its progress and a `Recorder` of its inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mavfi_cli.autonomy.pilot import PilotMode
from mavfi_cli.core.flight_record import Event
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import Briefing, FloatArray, VehicleState
from mavfi_cli.link.session import OffboardSession, Phase
from mavfi_cli.link.telemetry import Telemetry

if TYPE_CHECKING:
    from mavfi_cli.companion.injection import NoInjection
    from mavfi_cli.companion.pipeline import Companion

_PROGRESS_EVERY_S = 1.0
_MOST_TEXTS = 1000  # maximum autopilot texts in a record
_MODES = {  # kind and text of the event that marks the start of a pilot mode
    PilotMode.SLOWING: ("slow", "slows down before an obstacle"),
    PilotMode.STOPPING: ("stop", "stops before an obstacle"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightProgress:
    """The progress of a flight, reported to a `Watcher` once per simulated second."""

    stamp_s: float
    phase: str
    speed_mps: float
    goal_distance_m: float | None
    replans: int


class Watcher:
    """Receives the progress and the events of a flight. The base class ignores them."""

    def on_progress(self, progress: FlightProgress) -> None:
        """Handle a progress report, once per simulated second."""

    def on_note(self, text: str) -> None:
        """Handle the announcement of a long operation that is not part of the flight."""

    def on_event(self, event: Event) -> None:
        """Handle an event of the flight when it is logged."""


class Recorder:
    """Records the briefing of a flight, and the inputs of its nodes.

    Attributes:
        orders: Input and start stamp of every invocation, by node.
        sequence: Node of every invocation, in order of start.
    """

    def __init__(self) -> None:
        self.briefing: Briefing | None = None
        self.orders: dict[str, list[tuple[Any, float]]] = {}
        self.sequence: list[str] = []

    def on_start(self, node: str, value: Any, start_s: float) -> None:
        """Record the input and the start stamp of an invocation of a node."""
        self.orders.setdefault(node, []).append((value, start_s))
        self.sequence.append(node)


class FlightLogger:
    """Detects events by comparing consecutive ticks, and reports them to a watcher."""

    def __init__(self, watcher: Watcher) -> None:
        self.events: list[Event] = []
        self._watcher = watcher
        self._phase: Phase | None = None
        self._mode: PilotMode | None = None
        self._texts = self._noted_texts = 0
        self._losses = 0
        self._next_progress_s = 0.0

    def note(self, stamp_s: float, kind: str, text: str, state: VehicleState | None) -> None:
        """Log an event at the vehicle's position."""
        place = None if state is None else state.position_enu_m
        event = self.event(stamp_s, kind, text, place)
        self.events.append(event)
        self._watcher.on_event(event)

    @staticmethod
    def event(stamp_s: float, kind: str, text: str, place_enu_m: FloatArray | None) -> Event:
        """Return an event whose stamp and position are rounded as in a record.

        Args:
            place_enu_m: Position, of shape (3,).
        """
        place = None
        if place_enu_m is not None:
            x, y, z = (round(float(c), 3) for c in place_enu_m)
            place = (x, y, z)
        return Event(stamp_s=round(stamp_s, 3), kind=kind, text=text, position_enu_m=place)

    def log_tick(
        self,
        stamp_s: float,
        session: OffboardSession,
        companion: Companion | None,
        injection: NoInjection,
    ) -> None:
        """Log the new events of a control tick, and report progress once per simulated second."""
        state, phase = session.state, session.phase
        if phase is not self._phase:
            self._phase = phase
            self.note(stamp_s, "phase", phase.value, state)
        self.log_texts(stamp_s, session.telemetry)
        for text in injection.news():
            self.note(stamp_s, "fault", text, state)
        if companion is not None:
            self._log_companion(companion, stamp_s, session)
        if state is not None and stamp_s >= self._next_progress_s:
            self._next_progress_s = stamp_s + _PROGRESS_EVERY_S
            pilot = None if companion is None else companion.pilot
            goal_m = None if pilot is None else norm(state.position_enu_m - pilot.goal_enu_m)
            self._watcher.on_progress(
                FlightProgress(
                    stamp_s=stamp_s,
                    phase=pilot.mode.value if pilot and phase is Phase.OFFBOARD else phase.value,
                    speed_mps=norm(state.velocity_enu_mps),
                    goal_distance_m=goal_m,
                    replans=0 if pilot is None else pilot.counters.replans,
                )
            )

    def log_texts(self, stamp_s: float, telemetry: Telemetry) -> None:
        """Log the text messages from the autopilot that are new since the last call."""
        texts = telemetry.texts
        for received in texts.since(self._texts):
            if self._noted_texts <= _MOST_TEXTS:
                last = self._noted_texts == _MOST_TEXTS
                text = "further texts are not recorded" if last else received.text
                self.note(stamp_s, "autopilot", text, telemetry.state)
                self._noted_texts += 1
        self._texts = texts.total

    def _log_companion(
        self, companion: Companion, stamp_s: float, session: OffboardSession
    ) -> None:
        for text in companion.protection.news():
            self.note(stamp_s, "alarm", text, session.state)
            session.announce(text)
        losses = companion.executor.losses
        for loss in losses[self._losses :]:
            text = f"node {loss.node} {'' if loss.hung else 'crashed: '}{loss.how}"
            self.note(stamp_s, "node", text, session.state)
        self._losses = len(losses)
        mode, before = companion.pilot.mode, self._mode
        self._mode = mode
        if mode is before:
            return
        if mode in _MODES:
            self.note(stamp_s, *_MODES[mode], session.state)
        elif mode is PilotMode.FLYING and before is not None:
            again = companion.pilot.counters.replans > 0
            kind, text = ("replan", "flies a new plan") if again else ("plan", "flies a plan")
            self.note(stamp_s, kind, text, session.state)
