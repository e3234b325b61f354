"""As `task`, for missions with attacked nodes: the program that forks the nodes is started once."""

from __future__ import annotations

from mavfi_cli.campaigns import task
from mavfi_cli.campaigns.task import perform

__all__ = ["perform", "prepare"]


def prepare() -> None:
    """Load everything that a mission needs, and wait until the nodes' program has loaded too."""
    from mavfi_cli.mission.instruction.forked_node import load_program, start_program

    start_program()
    task.prepare()
    load_program()
