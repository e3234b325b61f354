"""Logs the events of a flight after every tick and reports progress."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mavfi_cli.autonomy.pilot import PilotMode
from mavfi_cli.core.types import VehicleState
from mavfi_cli.link.session import OffboardSession, Phase
from mavfi_cli.mission.progress import Event, FlightProgress, Watcher

if TYPE_CHECKING:
    from mavfi_cli.companion.injection import NoInjection
    from mavfi_cli.companion.pipeline import Companion

PROGRESS_EVERY_S = 1.0


class FlightLogger:
    """Finds events by comparing each tick with the last."""

    def __init__(self, watcher: Watcher) -> None:
        self.events: list[Event] = []
        self._watcher = watcher
        self._phase: Phase | None = None
        self._mode: PilotMode | None = None
        self._texts = 0
        self._losses = 0
        self._next_progress_s = 0.0

    def note(self, stamp_s: float, kind: str, text: str, state: VehicleState | None) -> None:
        """Log an event at the vehicle's position."""
        place = None
        if state is not None:
            x, y, z = (round(float(c), 3) for c in state.position_enu_m)
            place = (x, y, z)
        event = Event(stamp_s=round(stamp_s, 3), kind=kind, text=text, position_enu_m=place)
        self.events.append(event)
        self._watcher.on_event(event)

    def tell(
        self,
        stamp_s: float,
        session: OffboardSession,
        companion: Companion | None,
        injection: NoInjection,
    ) -> None:
        """Log the events of a tick, and report progress once per simulated second."""
        state = session.state
        for kind, text in self._news(session, companion, injection):
            self.note(stamp_s, kind, text, state)
        if state is not None and stamp_s >= self._next_progress_s:
            self._next_progress_s = stamp_s + PROGRESS_EVERY_S
            self._watcher.on_progress(_progress(stamp_s, state, session, companion))

    def _news(
        self,
        session: OffboardSession,
        companion: Companion | None,
        injection: NoInjection,
    ) -> list[tuple[str, str]]:
        """Return kind and text of each event since the last tick."""
        news: list[tuple[str, str]] = []
        if session.phase is not self._phase:
            self._phase = session.phase
            news.append(("phase", session.phase.value))
        texts = session.telemetry.texts
        news += [("autopilot", each.text.strip()) for each in texts.since(self._texts)]
        self._texts = texts.total
        news += [("fault", text) for text in injection.news()]
        if companion is not None:
            alarms = companion.protection.news()
            news += [("alarm", text) for text in alarms]
            for text in alarms:
                session.announce(text)
            news += self._losses_since(companion)
            news += self._mode_since(companion)
        return news

    def _losses_since(self, companion: Companion) -> list[tuple[str, str]]:
        losses = companion.executor.losses
        fresh = losses[self._losses :]
        self._losses = len(losses)
        return [
            ("node", f"node {loss.node} {'' if loss.hung else 'crashed: '}{loss.how}")
            for loss in fresh
        ]

    def _mode_since(self, companion: Companion) -> list[tuple[str, str]]:
        mode, before = companion.mode, self._mode
        self._mode = mode
        if mode is before:
            return []
        if mode is PilotMode.SLOWING:
            return [("slow", "slows down before an obstacle")]
        if mode is PilotMode.STOPPING:
            return [("stop", "stops before an obstacle")]
        if mode is PilotMode.FLYING and before is not None:
            again = companion.pilot.counters.replans > 0
            return [("replan", "flies a new plan") if again else ("plan", "flies a plan")]
        return []


def _progress(
    stamp_s: float, state: VehicleState, session: OffboardSession, companion: Companion | None
) -> FlightProgress:
    offboard = companion is not None and session.phase is Phase.OFFBOARD
    return FlightProgress(
        stamp_s=stamp_s,
        phase=companion.mode.value if offboard and companion else session.phase.value,
        speed_mps=float(np.linalg.norm(state.velocity_enu_mps)),
        goal_distance_m=None if companion is None else companion.goal_distance_m(state),
        replans=0 if companion is None else companion.pilot.counters.replans,
    )
