"""Counts how often a program executes each instruction in one run, using valgrind's callgrind.

Callgrind takes 10 to 60 times as long as the program. It writes a file of counts after every
`_BLOCKS` basic blocks and one at the end; their sum covers the whole run. The finished files give
the counting rate. The remaining time is estimated from the CPU time that a native run takes to
reach the same counts.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mavfi_cli.attack.place import Golden
from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.fork_server import die_with
from mavfi_cli.fi.tracer.spawn import Program

# Execution counts by object path (or UNNAMED), then by linked address.
Executions = Mapping[str, Mapping[int, int]]
UNNAMED = "???"  # code that valgrind assigns to no object; its addresses are those in memory

_SLOWER = 200.0
_START_S = 60.0
_REPORT_EVERY_S = 1.0
_LAST_BYTES = 64  # bytes at the end of a file; they include its last line
_BLOCKS = 200_000_000  # basic blocks between two files: 10 to 20 s


def find_valgrind() -> str | None:
    """Return the path of valgrind, or None if it is not installed."""
    return shutil.which("valgrind")


def count_executions(
    command: Program,
    *,
    stdout: Path,
    stderr: Path,
    counts: Path,
    golden: Golden,
    native_s: Callable[[Executions], float | None],
    report: Callable[[str], None] = lambda _: None,
) -> tuple[int, Executions]:
    """Run a program under callgrind, and return its exit code and its execution counts.

    Args:
        counts: path of callgrind's output. Callgrind also writes numbered files with this prefix.
        golden: the golden run, whose duration limits that of the run under callgrind.
        native_s: maps the execution counts so far to the CPU time, in seconds, of a native run up
            to that point, or to None if the time is unknown.
        report: called every second with a description of the progress.

    Raises:
        TargetError: the program does not end in time, or a signal kills it.
    """
    name = Path(command.argv[0]).name
    tool = [
        str(find_valgrind()), "--quiet", "--tool=callgrind", "--dump-instr=yes",
        "--compress-pos=no", "--compress-strings=no", "--skip-plt=no", "--log-file=/dev/null",
        "--vgdb=no", f"--dump-every-bb={_BLOCKS}", f"--callgrind-out-file={counts}", "--",
    ]  # fmt: skip
    count, process = _Count(counts=counts, golden=golden, native_s=native_s), None
    try:
        with (
            open(command.stdin, "rb") as given,
            open(stdout, "wb") as out,
            open(stderr, "wb") as err,
        ):
            process = subprocess.Popen(
                [*tool, *command.argv], cwd=command.directory, env=dict(command.environment),
                stdin=given, stdout=out, stderr=err, start_new_session=True,
                preexec_fn=functools.partial(die_with, os.getpid()),
            )  # fmt: skip
        code = _await_end(process, name, count, report)
    finally:
        if process is not None and process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if code < 0:
        raise TargetError(name, f"was killed by signal {-code} while it ran under callgrind")
    count.read_rest()
    return code, count.executions


@dataclass(slots=True)
class _Count:
    """The execution counts of a run so far, and a forecast of how long the run takes."""

    counts: Path
    golden: Golden
    native_s: Callable[[Executions], float | None]
    begun_s: float = field(default_factory=time.monotonic)
    executions: dict[str, Counter[int]] = field(default_factory=dict)
    read: int = 0  # files
    rate: float = 0.0  # instructions/s
    forecast_s: float | None = None  # whole duration
    forecast_at_s: float = 0.0

    @property
    def limit_s(self) -> float:
        """The longest allowed duration of the run under callgrind, in seconds."""
        return _SLOWER * self.golden.wall_s + _START_S

    def update(self) -> str:
        """Add the counts of newly finished files, and return a description of the progress."""
        elapsed_s = time.monotonic() - self.begun_s
        if self._read_files():
            counted = sum(sum(counts.values()) for counts in self.executions.values())
            self.rate = counted / elapsed_s
            if elapsed_s > 2 * self.forecast_at_s:
                self.forecast_at_s, reached_s = elapsed_s, self.native_s(self.executions)
                if reached_s:
                    self.forecast_s = elapsed_s * max(1.0, self.golden.cpu_s / reached_s)
        return "; ".join(self._words(time.monotonic() - self.begun_s))

    def _words(self, elapsed_s: float) -> Iterator[str]:
        yield f"counted by callgrind, {elapsed_s:.0f} s of at most {self.limit_s:.0f} s"
        if self.rate:
            yield f"{self.rate / 1e6:.3g} million instructions a second"
        if self.forecast_s is not None:
            yield f"about {max(0.0, self.forecast_s - elapsed_s):.0f} s left"

    def read_rest(self) -> None:
        """Add the counts of the remaining files, after callgrind has ended."""
        self._read_files()
        self._add(self.counts)

    def _read_files(self) -> bool:
        """Add the counts of newly finished numbered files. Return False if there are none."""
        before = self.read
        while _is_complete(path := Path(f"{self.counts}.{self.read + 1}")):
            self._add(path)
        return self.read > before

    def _add(self, path: Path) -> None:
        self.read += 1
        for name, counts in _read_counts(path).items():
            self.executions.setdefault(name, Counter()).update(counts)
        path.unlink()


def _await_end(
    process: subprocess.Popen[bytes], name: str, count: _Count, report: Callable[[str], None]
) -> int:
    """Wait for callgrind to end, report its progress meanwhile, and return its exit code."""
    while (left_s := count.begun_s + count.limit_s - time.monotonic()) > 0:
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(min(_REPORT_EVERY_S, left_s))
        report(count.update())
    raise TargetError(name, f"did not end under callgrind within {count.limit_s:.0f} s")


def _is_complete(path: Path) -> bool:
    """Return True if callgrind has finished the file, which then ends with a line of totals."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _LAST_BYTES))
            return b"\ntotals: " in file.read()
    except OSError:
        return False


def _read_counts(path: Path) -> dict[str, Counter[int]]:
    """Read the execution counts in a file, keyed by the path of the object, then by address.

    Args:
        path: a file of callgrind, with linked addresses. The line after `calls=` holds the cost of
            the called function and is skipped.
    """
    counts: dict[str, Counter[int]] = {}
    current: Counter[int] = Counter()
    of_callee = False
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.startswith("0x"):
                if not of_callee:
                    address, _, count = line.split()
                    current[int(address, 16)] += int(count)
                of_callee = False
            elif line.startswith("ob="):
                name = line[3:].rstrip("\n")
                name = name if name == UNNAMED else os.path.realpath(name)
                current = counts.setdefault(name, Counter())
            elif line.startswith("calls="):
                of_callee = True
    return counts
