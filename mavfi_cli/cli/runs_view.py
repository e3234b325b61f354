"""Progress of runs of isolated kernels on stderr: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from mavfi_cli.cli.missions_view import PLAIN_EVERY_S

Show = Callable[[str, int], None]


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


@contextmanager
def runs_view(kernels: Sequence[str], runs: int) -> Iterator[Show]:
    """What is to be called with a kernel and how many of its runs are there."""
    if not sys.stderr.isatty():
        yield PlainRuns(kernels, runs).show
        return
    make: Any = click.progressbar
    length, names = runs * len(kernels), list(kernels)
    with make(length=length, file=sys.stderr, item_show_func=lambda name: name) as bar:
        reached = 0

        def show(kernel: str, done: int) -> None:
            """Move the bar to a kernel's so many runs."""
            nonlocal reached
            position = names.index(kernel) * runs + done
            bar.update(position - reached, kernel)
            reached = position

        yield show
