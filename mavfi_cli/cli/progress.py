"""Shows progress on stderr: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from mavfi_cli.campaigns.progress import Progress, Spectator, duration
from mavfi_cli.core.errors import printable
from mavfi_cli.core.flight_record import Event
from mavfi_cli.core.terminal import cleaned, note
from mavfi_cli.mission.progress import FlightProgress, Watcher

if TYPE_CHECKING:
    from rich.live import Live

    from mavfi_cli.spec.mission import MissionConfig

PLAIN_EVERY_S, _REDRAW_S = 10.0, 0.05
_NOTED = ("phase", "autopilot", "plan", "stop", "fault", "alarm", "node", "outcome")
_MOST_SETTINGS = 6  # with more settings, no rates are shown here; `campaign status` shows all
_Part = str | tuple[str, str]  # text, or a text with its style on a terminal


class _Lines:
    """Prints notes at once, and progress as a plain line at most every ten seconds.

    Args:
        first_s: time of the earliest line of progress, in seconds after the start.
    """

    def __init__(self, first_s: float) -> None:
        self._next_s, self._last_s = first_s, 0.0

    def note(self, *parts: _Part) -> None:
        note("".join(p if isinstance(p, str) else p[0] for p in parts))

    def update(self, text: str, at_s: float, *, last: bool = False) -> None:
        if at_s < self._last_s:  # the next campaign has begun
            self._next_s = 0.0
        self._last_s = at_s
        if at_s >= self._next_s or last:
            self._next_s = at_s + PLAIN_EVERY_S
            self.note(text)


class _LiveLine(_Lines):
    """Shows progress in one line that is rewritten in place. Notes scroll above it."""

    def __init__(self, live: Live) -> None:
        self._live, self._next_s = live, 0.0

    def note(self, *parts: _Part) -> None:
        from rich.text import Text  # no markup: an autopilot may send any text

        cleaned_parts = [cleaned(p) if isinstance(p, str) else (cleaned(p[0]), p[1]) for p in parts]
        self._live.console.print(Text.assemble(*cleaned_parts))

    def update(self, text: str, at_s: float, *, last: bool = False) -> None:
        from rich.text import Text

        now_s = time.monotonic()
        if now_s >= self._next_s or last:  # drawing takes longer than some updates
            self._next_s = now_s + _REDRAW_S
            self._live.update(Text(cleaned(text)), refresh=True)


@contextmanager
def _screen(first_s: float) -> Iterator[_Lines]:
    """Open a view of progress on stderr: a live line on a terminal, plain lines elsewhere.

    Plain lines of progress begin after `first_s` seconds.
    """
    if not sys.stderr.isatty():
        yield _Lines(first_s)
        return
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    # No refresh thread: a mission may fork, and a process that forks must have one thread only.
    with Live("starting", console=console, auto_refresh=False, transient=True) as live:
        yield _LiveLine(live)


class _FlightView(Watcher):
    def __init__(self, screen: _Lines, title: str) -> None:
        self._screen, self._title = screen, title

    def on_note(self, text: str) -> None:
        self._screen.note(text)

    def on_progress(self, progress: FlightProgress) -> None:
        line = f"{progress.stamp_s:7.2f} s  {progress.phase:<12} "
        if progress.goal_distance_m is not None:
            line += f"{progress.goal_distance_m:5.1f} m to go  "
        line += f"{progress.speed_mps:.1f} m/s"
        line += f"  replans {progress.replans}" if progress.replans else ""
        self._screen.update(line, progress.stamp_s)

    def on_event(self, event: Event) -> None:
        if self._title:  # not earlier, so that a mission that cannot begin prints only one line
            self._screen.note((self._title, "bold"))
            self._title = ""
        if event.kind in _NOTED:
            self._screen.note((f"{event.stamp_s:7.2f} s", "dim"), "  ", printable(event.text))


class _MissionsView(Spectator):
    def __init__(self, screen: _Lines) -> None:
        self._screen = screen

    def on_progress(self, progress: Progress) -> None:
        """Show missions, rate, remaining time and success rates so far in one line."""
        parts = [f"{progress.over}/{progress.total} missions", f"{progress.running} flying"]
        if progress.eta_s is not None:
            parts.append(f"{progress.rate_per_h:.0f} an hour")
            if progress.over < progress.total:
                parts.append(f"{duration(progress.eta_s)} to go")
        if progress.success_rate is not None:
            success = f"{100.0 * progress.success_rate:.1f} % success"
            if 2 <= len(progress.outcomes) <= _MOST_SETTINGS:
                rates = progress.success_rates.items()
                success += f" ({', '.join(f'{name} {100.0 * rate:.1f}' for name, rate in rates)})"
            parts.append(success)
        if progress.again:
            parts.append(f"{progress.again} begun again")
        last = progress.over == progress.total
        self._screen.update(", ".join(parts), progress.elapsed_s, last=last)

    def on_end(self, progress: Progress) -> None:
        """Print how long the missions took, unless no mission was flown."""
        if flown := progress.over - progress.before:
            line = f"{flown} missions in {duration(progress.elapsed_s)}"
            line += f", {progress.rate_per_h:.0f} an hour"
            if progress.outside is not None:
                line += f", {100.0 * progress.outside:.1f} % of it outside missions"
            self._screen.note(line)

    def on_note(self, text: str) -> None:
        self._screen.note(text)

    def on_step(self, text: str, elapsed_s: float) -> None:
        self._screen.update(text, elapsed_s)


class _RunsView:
    """Shows the progress of runs of isolated kernels, and the time left.

    Args:
        kernels: names of all kernels, in the order in which they run.
        runs: number of runs of each kernel.
    """

    def __init__(self, screen: _Lines, kernels: Sequence[str], runs: int) -> None:
        self._screen, self._kernels, self._runs = screen, list(kernels), runs
        self._begun_s, self._kernel = time.monotonic(), ""

    def show(self, kernel: str, done: int) -> None:
        """Show that `done` runs of a kernel are complete."""
        if kernel != self._kernel:
            self._kernel = kernel
            self.note(f"{kernel}: golden run and profile")
        over = self._kernels.index(kernel) * self._runs + done
        total, elapsed_s = self._runs * len(self._kernels), self._elapsed_s()
        text = f"{kernel}: {done}/{self._runs} runs; {over}/{total} in all"
        if 0 < over < total:
            text += f", {duration(elapsed_s * (total - over) / over)} to go"
        self._screen.update(text, elapsed_s, last=over == total)

    def stage(self, what: str) -> None:
        """Show a step of the preparation that precedes the first run of a kernel."""
        self._screen.update(f"{self._kernel}: {what}", self._elapsed_s())

    def note(self, text: str) -> None:
        """Print a note at once."""
        self._screen.note(text)

    def _elapsed_s(self) -> float:
        return time.monotonic() - self._begun_s


@contextmanager
def runs_view(kernels: Sequence[str], runs: int) -> Iterator[_RunsView]:
    """Show the progress of runs of isolated kernels on stderr, as a context manager.

    Args:
        kernels: names of all kernels, in the order in which they run.
        runs: number of runs of each kernel.
    """
    with _screen(PLAIN_EVERY_S) as screen:
        yield _RunsView(screen, kernels, runs)


@contextmanager
def progress_view(config: MissionConfig, *, quiet: bool) -> Iterator[Watcher]:
    """Show the progress of one mission on stderr, as a context manager.

    It yields the watcher to pass to the mission. With `quiet`, the watcher shows nothing.
    """
    if quiet:
        yield Watcher()
        return
    where = config.link or f"{config.world}, seed {config.seed}"
    title = f"Flying {config.vehicle} in {where}" if config.link is None else f"Flying {where}"
    with _screen(PLAIN_EVERY_S) as screen:
        yield _FlightView(screen, title)


@contextmanager
def missions_view(*, quiet: bool) -> Iterator[Spectator]:
    """Show the progress of many missions on stderr, as a context manager.

    It yields the spectator to pass to the campaign. With `quiet`, the spectator shows nothing.
    """
    if quiet:
        yield Spectator()
        return
    with _screen(0.0) as screen:
        yield _MissionsView(screen)


@contextmanager
def steps_view() -> Iterator[Callable[[str], None]]:
    """Show the steps of a computation on stderr, as a context manager.

    It yields a function to call with the name of each step when the step begins.
    """
    begun_s = time.monotonic()
    with _screen(PLAIN_EVERY_S) as screen:
        yield lambda name: screen.update(f"{name} ...", time.monotonic() - begun_s)
