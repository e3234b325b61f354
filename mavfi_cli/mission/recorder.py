"""Recorder of the nodes' inputs in a flight, to repeat invocations without flying."""

from __future__ import annotations

from typing import Any

from mavfi_cli.core.types import Briefing


class Recorder:
    """Records the briefing, and input and start stamp of every invocation by node."""

    def __init__(self) -> None:
        self.briefing: Briefing | None = None
        self.orders: dict[str, list[tuple[Any, float]]] = {}

    def on_start(self, node: str, value: Any, start_s: float) -> None:
        """Record the start of an invocation."""
        self.orders.setdefault(node, []).append((value, start_s))
