"""Exact execution counts of every instruction of a program's run, by valgrind's callgrind."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer.spawn import Program

SLOWER = 200.0  # callgrind takes 10 to 60 times as long as the program
START_S = 60.0
_TOLD_EVERY_S = 1.0


def callgrind() -> str | None:
    """Path of valgrind; None if it is not installed."""
    return shutil.which("valgrind")


def run_counted(
    command: Program,
    *,
    stdout: Path,
    stderr: Path,
    counts: Path,
    wall_s: float,
    tell: Callable[[str], None] = lambda _: None,
) -> int:
    """Run a program under callgrind and return its exit code.

    Args:
        counts: file to which callgrind writes.
        wall_s: duration of the program without it.
        tell: called every second with how long it has been running, in words.

    Raises:
        TargetError: it does not end in time, or a signal kills it.
    """
    name, limit_s = Path(command.argv[0]).name, SLOWER * wall_s + START_S
    tool = [
        str(callgrind()), "--quiet", "--tool=callgrind", "--dump-instr=yes", "--compress-pos=no",
        "--compress-strings=no", "--skip-plt=no", "--log-file=/dev/null",
        f"--callgrind-out-file={counts}", "--",
    ]  # fmt: skip
    with open(command.stdin, "rb") as given, open(stdout, "wb") as out, open(stderr, "wb") as err:
        process = subprocess.Popen(
            [*tool, *command.argv], cwd=command.directory, env=dict(command.environment),
            stdin=given, stdout=out, stderr=err, start_new_session=True,
        )  # fmt: skip
    try:
        code = _await_end(process, name, limit_s, tell)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if code < 0:
        raise TargetError(name, f"is killed by signal {-code} under callgrind")
    return code


def _await_end(
    process: subprocess.Popen[bytes], name: str, limit_s: float, tell: Callable[[str], None]
) -> int:
    """Wait for the exit code; tell how long it takes."""
    begun_s = time.monotonic()
    while (elapsed_s := time.monotonic() - begun_s) < limit_s:
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(min(_TOLD_EVERY_S, limit_s - elapsed_s))
        tell(f"counted by callgrind, {elapsed_s:.0f} s of at most {limit_s:.0f} s")
    raise TargetError(name, f"has not ended under callgrind after {limit_s:.0f} s")


def read_counts(path: Path, objects: Iterable[str]) -> dict[str, Counter[int]]:
    """Executions of each instruction, by the path of its object and its linked address.

    Args:
        path: callgrind's file; addresses are those of the linker, and the line after `calls=` is
            the cost of the called function.
        objects: paths of the wanted objects.
    """
    found: dict[str, Counter[int]] = {each: Counter() for each in objects}
    current: Counter[int] | None = None
    of_callee = False
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.startswith("0x"):
                if current is not None and not of_callee:
                    address, _, count = line.split()
                    current[int(address, 16)] += int(count)
                of_callee = False
            elif line.startswith("ob="):
                current = found.get(os.path.realpath(line[3:].rstrip("\n")))
            elif line.startswith("calls="):
                of_callee = True
    return found
