"""Progress of many missions on stderr: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from mavfi_cli.campaigns.progress import Progress, Spectator

if TYPE_CHECKING:
    from rich.live import Live

PLAIN_EVERY_S = 10.0
_MOST_SETTINGS = 6  # more settings have no rates here; `campaign status` shows all


class _Plain(Spectator):
    """Print a line every ten seconds, and one at the end of each campaign."""

    def __init__(self) -> None:
        self._next_s = self._last_s = 0.0

    def on_progress(self, progress: Progress) -> None:
        """Print a line every ten seconds, and one at the end."""
        if progress.elapsed_s < self._last_s:  # the next campaign
            self._next_s = 0.0
        self._last_s = progress.elapsed_s
        if progress.elapsed_s >= self._next_s or progress.over == progress.total:
            self._next_s = progress.elapsed_s + PLAIN_EVERY_S
            click.echo(progress_line(progress), err=True)

    def on_end(self, progress: Progress) -> None:
        """Print the time that the missions took."""
        if line := _end_line(progress):
            click.echo(line, err=True)

    def on_note(self, text: str) -> None:
        """Print a line."""
        click.echo(text, err=True)


class _Live(Spectator):
    """One line that is rewritten, with notes scrolling above it."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def on_progress(self, progress: Progress) -> None:
        """Rewrite the line."""
        self._live.update(progress_line(progress), refresh=True)

    def on_end(self, progress: Progress) -> None:
        """Print the time that the missions took above the line."""
        if line := _end_line(progress):
            self.on_note(line)

    def on_note(self, text: str) -> None:
        """Print above the line, without markup."""
        from rich.text import Text

        self._live.console.print(Text(text))


def progress_line(progress: Progress) -> str:
    """One line: missions, rate, remaining time, success rates so far."""
    parts = [f"{progress.over}/{progress.total} missions", f"{progress.running} flying"]
    if progress.eta_s is not None:
        parts.append(f"{progress.rate_per_h:.0f} an hour")
        if progress.over < progress.total:
            parts.append(f"{_duration(progress.eta_s)} to go")
    if progress.success_rate is not None:
        parts.append(f"{_percent(progress.success_rate)} % success{_by_setting(progress)}")
    if progress.again:
        parts.append(f"{progress.again} begun again")
    return ", ".join(parts)


def _by_setting(progress: Progress) -> str:
    """The rate of each setting, if there are few."""
    if not 2 <= len(progress.outcomes) <= _MOST_SETTINGS:
        return ""
    rates = [f"{name} {_percent(rate)}" for name, rate in progress.success_rates.items()]
    return f" ({', '.join(rates)})"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f}"


def _end_line(progress: Progress) -> str:
    """The time that the missions took; empty if none was flown."""
    flown = progress.over - progress.before
    if not flown:
        return ""
    line = f"{flown} missions in {_duration(progress.elapsed_s)}, {progress.rate_per_h:.0f} an hour"
    outside = progress.outside
    return line if outside is None else f"{line}, {100.0 * outside:.1f} % of it outside missions"


def _duration(seconds: float) -> str:
    minutes, left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{left:02d} h" if hours else f"{minutes}:{left:02d} min"


@contextmanager
def missions_view(*, quiet: bool) -> Iterator[Spectator]:
    """The spectator for stderr: none, plain lines, or a live line."""
    if quiet:
        yield Spectator()
    elif not sys.stderr.isatty():
        yield _Plain()
    else:
        from rich.console import Console
        from rich.live import Live

        console = Console(stderr=True)
        with Live("starting", console=console, auto_refresh=False, transient=True) as live:
            yield _Live(live)
