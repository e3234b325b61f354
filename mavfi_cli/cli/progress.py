"""Progress of a mission on stderr: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from mavfi_cli.mission.progress import Event, FlightProgress, Watcher

if TYPE_CHECKING:
    from rich.live import Live

    from mavfi_cli.spec.mission import MissionConfig

_PLAIN_EVERY_S = 10.0
_TOLD = ("phase", "autopilot", "plan", "stop", "fault", "alarm", "node", "outcome")


class _Plain(Watcher):
    """Print a line per event, and one every ten simulated seconds."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._next_s = _PLAIN_EVERY_S

    def on_progress(self, progress: FlightProgress) -> None:
        """Print a line every ten simulated seconds."""
        if progress.stamp_s >= self._next_s:
            self._next_s = progress.stamp_s + _PLAIN_EVERY_S
            click.echo(_line(progress), err=True)

    def on_note(self, text: str) -> None:
        """Print a line."""
        click.echo(text, err=True)

    def on_event(self, event: Event) -> None:
        """Print a line for events of interest."""
        if self._title:  # not earlier: a mission that cannot begin prints one line only
            click.echo(self._title, err=True)
            self._title = ""
        if event.kind in _TOLD:
            click.echo(f"{event.stamp_s:7.2f} s  {event.text}", err=True)


class _Live(Watcher):
    """One line that is rewritten, with events scrolling above it."""

    def __init__(self, live: Live, title: str) -> None:
        self._live = live
        self._title = title

    def on_progress(self, progress: FlightProgress) -> None:
        """Rewrite the line."""
        self._live.update(_line(progress), refresh=True)

    def on_note(self, text: str) -> None:
        """Print above the line."""
        from rich.text import Text

        self._live.console.print(Text(text))

    def on_event(self, event: Event) -> None:
        """Print events of interest above the line."""
        from rich.text import Text  # no markup: an autopilot may send any text

        if self._title:
            self._live.console.print(Text(self._title, "bold"))
            self._title = ""
        if event.kind in _TOLD:
            stamp = (f"{event.stamp_s:7.2f} s", "dim")
            self._live.console.print(Text.assemble(stamp, "  ", event.text))


def _line(progress: FlightProgress) -> str:
    goal = "" if progress.goal_distance_m is None else f"{progress.goal_distance_m:5.1f} m to go  "
    return (
        f"{progress.stamp_s:7.2f} s  {progress.phase:<12} {goal}"
        f"{progress.speed_mps:.1f} m/s  replans {progress.replans}"
    )


@contextmanager
def progress_view(config: MissionConfig, *, quiet: bool) -> Iterator[Watcher]:
    """The watcher that suits stderr: none, plain lines, or a live line."""
    if quiet:
        yield Watcher()
        return
    where = config.link or f"{config.world}, seed {config.seed}"
    title = f"Flying {config.vehicle} in {where}" if config.link is None else f"Flying {where}"
    if not sys.stderr.isatty():
        yield _Plain(title)
        return
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    # No refresh thread: a mission may fork, and a process that forks must have one thread only.
    with Live("starting", console=console, auto_refresh=False, transient=True) as live:
        yield _Live(live, title)
