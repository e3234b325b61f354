"""Progress of a campaign on stderr: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from mavfi_cli.campaign.progress import Progress, Spectator

if TYPE_CHECKING:
    from mavfi_cli.campaign.ledger import Ledger

_PLAIN_EVERY_S = 30.0


class _Plain(Spectator):
    """A line every half minute, and one at the end."""

    def __init__(self) -> None:
        self._next_s = 0.0

    def on_progress(self, progress: Progress) -> None:
        now = time.monotonic()
        if now >= self._next_s or not progress.running:
            self._next_s = now + _PLAIN_EVERY_S
            self._say(progress_line(progress))

    def on_note(self, text: str) -> None:
        click.echo(text, err=True)

    def _say(self, line: str) -> None:
        click.echo(line, err=True)


class _Live(Spectator):
    """One line that is rewritten; notes scroll above it."""

    def __init__(self) -> None:
        self._width = 0

    def on_progress(self, progress: Progress) -> None:
        line = progress_line(progress)
        click.echo("\r" + line.ljust(self._width), err=True, nl=not progress.running)
        self._width = len(line) if progress.running else 0

    def on_note(self, text: str) -> None:
        click.echo("\r" + text.ljust(self._width), err=True)


def progress_line(progress: Progress) -> str:
    """How far it is: missions, rate, time left, success so far."""
    parts = [f"{progress.over}/{progress.total} missions", f"{progress.running} flying"]
    if progress.eta_s is not None:
        parts += [f"{progress.rate_per_h:.0f} an hour", f"{_duration(progress.eta_s)} left"]
    if progress.success_rate is not None:
        parts.append(f"success {100 * progress.success_rate:.1f} %")
    if progress.again:
        parts.append(f"{progress.again} begun again")
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


@contextmanager
def progress_view(ledger: Ledger, *, quiet: bool) -> Iterator[Spectator]:
    """The spectator that suits stderr."""
    if quiet:
        yield Spectator()
        return
    click.echo(f"{ledger.meta('name')} in {ledger.folder}", err=True)
    yield _Live() if sys.stderr.isatty() else _Plain()
