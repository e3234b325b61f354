"""What a flight asks of its nodes, kept so that it can be asked again without flying."""

from __future__ import annotations

from typing import Any

from mavfi_cli.mission.briefing import Briefing


class Recorder:
    """Keeps the briefing of a flight, and input and start stamp of every invocation, by node."""

    def __init__(self) -> None:
        self.briefing: Briefing | None = None
        self.orders: dict[str, list[tuple[Any, float]]] = {}

    def on_start(self, node: str, value: Any, start_s: float) -> None:
        """An invocation begins."""
        self.orders.setdefault(node, []).append((value, start_s))
