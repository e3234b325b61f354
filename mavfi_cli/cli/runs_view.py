"""Progress of runs of isolated kernels on stderr: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import click

from mavfi_cli.cli.missions_view import PLAIN_EVERY_S


class RunsView(Protocol):
    """What a person sees of the runs, kernel by kernel."""

    def show(self, kernel: str, done: int) -> None:
        """A kernel's so many runs are there; 0: it begins."""

    def stage(self, what: str) -> None:
        """What goes on before the first run of the kernel that has begun."""


class PlainRuns:
    """A line where a kernel begins, one every ten seconds, and one at the end.

    Args:
        kernels: in the order in which they are attacked.
        runs: of each.
        clock: host time, s.
    """

    def __init__(
        self, kernels: Sequence[str], runs: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._kernels, self._runs, self._clock = list(kernels), runs, clock
        self._last_s = clock()
        self._kernel = ""

    def show(self, kernel: str, done: int) -> None:
        """Say so where a kernel begins, where ten seconds have passed, and where all is over."""
        now_s, total = self._clock(), self._runs * len(self._kernels)
        over = self._kernels.index(kernel) * self._runs + done
        if kernel != self._kernel:
            self._kernel = kernel
            click.echo(f"{kernel}: golden run and profile", err=True)
        elif over == total or now_s - self._last_s >= PLAIN_EVERY_S:
            click.echo(f"{kernel}: {done}/{self._runs} runs; {over}/{total} in all", err=True)
        else:
            return
        self._last_s = now_s

    def stage(self, what: str) -> None:
        """Say what goes on where ten seconds have passed."""
        now_s = self._clock()
        if now_s - self._last_s >= PLAIN_EVERY_S:
            click.echo(f"{self._kernel}: {what}", err=True)
            self._last_s = now_s


class LiveRuns:
    """A bar over all runs that names the kernel, and what goes on before its first run.

    Args:
        bar: click's.
        kernels, runs: as for `PlainRuns`.
    """

    def __init__(self, bar: Any, kernels: Sequence[str], runs: int) -> None:
        self._bar, self._kernels, self._runs = bar, list(kernels), runs
        self._kernel, self._reached = "", 0

    def show(self, kernel: str, done: int) -> None:
        """Move the bar to a kernel's so many runs."""
        self._kernel = kernel
        position = self._kernels.index(kernel) * self._runs + done
        self._bar.update(position - self._reached, kernel)
        self._reached = position

    def stage(self, what: str) -> None:
        """Say it beside the bar."""
        self._bar.current_item = f"{self._kernel}: {what}"
        self._bar.render_progress()


@contextmanager
def runs_view(kernels: Sequence[str], runs: int) -> Iterator[RunsView]:
    """The view that suits stderr: plain lines, or a bar."""
    if not sys.stderr.isatty():
        yield PlainRuns(kernels, runs)
        return
    make: Any = click.progressbar
    length = runs * len(kernels)
    with make(length=length, file=sys.stderr, item_show_func=lambda name: name) as bar:
        yield LiveRuns(bar, kernels, runs)
