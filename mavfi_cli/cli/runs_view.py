"""Progress of runs of isolated kernels on stderr: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from mavfi_cli.cli.progress import PLAIN_EVERY_S


class PlainRuns:
    """Print a line when a kernel begins, every ten seconds, and at the end.

    Args:
        clock: host time, s.
    """

    def __init__(
        self, kernels: Sequence[str], runs: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._kernels, self._runs, self._clock = list(kernels), runs, clock
        self._last_s = clock()
        self._kernel = ""

    def show(self, kernel: str, done: int) -> None:
        """Print a line when a kernel begins, after ten seconds, and at the end."""
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
        """Print the step after ten seconds."""
        now_s = self._clock()
        if now_s - self._last_s >= PLAIN_EVERY_S:
            click.echo(f"{self._kernel}: {what}", err=True)
            self._last_s = now_s


class _LiveRuns:
    """A bar over all runs that names the kernel, and the step before its first run."""

    def __init__(self, bar: Any, kernels: Sequence[str], runs: int) -> None:
        self._bar, self._kernels, self._runs = bar, list(kernels), runs
        self._kernel, self._reached = "", 0

    def show(self, kernel: str, done: int) -> None:
        """Move the bar to `done` runs of the kernel."""
        self._kernel = kernel
        position = self._kernels.index(kernel) * self._runs + done
        self._bar.update(position - self._reached, kernel)
        self._reached = position

    def stage(self, what: str) -> None:
        """Show the step beside the bar."""
        self._bar.current_item = f"{self._kernel}: {what}"
        self._bar.render_progress()


@contextmanager
def runs_view(kernels: Sequence[str], runs: int) -> Iterator[PlainRuns | _LiveRuns]:
    """The view for stderr: plain lines, or a bar."""
    if not sys.stderr.isatty():
        yield PlainRuns(kernels, runs)
        return
    make: Any = click.progressbar
    length = runs * len(kernels)
    with make(length=length, file=sys.stderr, item_show_func=lambda name: name) as bar:
        yield _LiveRuns(bar, kernels, runs)
