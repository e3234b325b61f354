"""A whole run as execution counts: the population of a program that is too long to be stepped.

The k-th execution of an instruction is reached by counting. Instructions that always execute
together have the same counts; so a hot one is counted at a place among them where a detour fits,
that is, where nothing jumps between the replaced instructions: one of them leads to the next, and
both are executed equally often.

valgrind's callgrind counts: exactly, in one run.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer.arch import TRAITS, Detour, Flow, flow
from mavfi_cli.fi.tracer.fault import CountedStop
from mavfi_cli.fi.tracer.image import Location
from mavfi_cli.fi.tracer.spawn import Program

Locate = Callable[[int], Location]
CodeAt = Callable[[int], bytes]  # 16 bytes of code

_BY_BREAKPOINT = 100_000  # most executions that are counted by a breakpoint: about a second


@dataclass(frozen=True, kw_only=True, eq=False)
class CountedRun:
    """How often each instruction in scope is executed in one run.

    Attributes:
        addresses: (n,) instructions, ascending.
        counts: (n,) executions of each.
        places: (n,) index of the instruction at which each is counted.
        detours: for each instruction, the detour that counts it; None if none fits.
    """

    addresses: NDArray[np.int64]
    counts: NDArray[np.int64]
    places: NDArray[np.int64]
    detours: tuple[Detour | None, ...]

    @classmethod
    def of(cls, executions: Mapping[int, int], code_at: CodeAt) -> CountedRun:
        """Make the population from the number of executions of each address."""
        addresses = sorted(executions)
        flows = [flow(code_at(address), address) for address in addresses]
        counts = _without_repeats(addresses, [executions[each] for each in addresses], flows)
        joined = _joined(addresses, counts, flows)
        known = dict(zip(addresses, counts, strict=True))
        sizes = [_straight_bytes(address, code_at, known.get) for address in addresses]
        detours = tuple(_detours(addresses, sizes, flows))
        return cls(
            addresses=np.array(addresses, np.int64),
            counts=np.array(counts, np.int64),
            places=np.array(_places(detours, joined), np.int64),
            detours=detours,
        )

    @functools.cached_property
    def reached(self) -> NDArray[np.int64]:
        """(n,) executions of each instruction, from the first, that can be reached."""
        detoured = np.array([self.detours[place] is not None for place in self.places])
        return np.where(detoured, self.counts, np.minimum(self.counts, _BY_BREAKPOINT))

    @functools.cached_property
    def _ends(self) -> NDArray[np.int64]:
        return np.cumsum(self.reached)

    @property
    def executed(self) -> int:
        """Number of executed instructions that can be reached."""
        return int(self._ends[-1]) if len(self._ends) else 0

    @property
    def not_reached(self) -> float:
        """Share of the executed instructions that cannot be reached."""
        return 1.0 - self.executed / max(1, int(self.counts.sum()))

    def _at(self, position: int) -> tuple[int, int]:
        """Index and number of the execution, from 1, of one executed instruction."""
        index = int(np.searchsorted(self._ends, position, side="right"))
        return index, position - int(self._ends[index] - self.reached[index]) + 1

    def address(self, position: int) -> int:
        """The address of one executed instruction."""
        return int(self.addresses[self._at(position)[0]])

    def trigger(
        self, position: int, locate: Locate, _: CodeAt
    ) -> tuple[tuple[CountedStop, ...], int]:
        """The trigger of one executed instruction, and k, the number of its execution."""
        index, k = self._at(position)
        return self.stages(index, k, locate), k

    def stages(self, index: int, k: int, locate: Locate) -> tuple[CountedStop, ...]:
        """The stages to execution k of an instruction."""
        place = int(self.places[index])
        here, there = (locate(int(self.addresses[at])) for at in (index, place))
        detour = self.detours[place]
        if place == index:
            return (CountedStop(here, k, detour),)
        before = k if place < index else k - 1  # executions of the place until then
        first = (CountedStop(there, before, detour),) if before else ()
        return (*first, CountedStop(here, 1))


def detour_at(
    address: int, code_at: CodeAt, executions: Callable[[int], int | None]
) -> Detour | None:
    """The detour at one instruction; None if none fits there.

    Args:
        executions: function from an address to the number of its executions.
    """
    size = _straight_bytes(address, code_at, executions)
    return Detour(size) if size >= TRAITS.jump_bytes else None


def _straight_bytes(address: int, code_at: CodeAt, executions: Callable[[int], int | None]) -> int:
    """Bytes of the instructions from one on that a detour can replace, as many as it needs."""
    size, expected = 0, None
    while (how := flow(code_at(address + size), address + size)) is not None and how.movable:
        size += how.size
        if size >= TRAITS.jump_bytes or not how.straight:
            return size
        expected = expected or executions(address)
        if executions(address + size) != expected:
            return size
    return size if how is not None else 0


def _without_repeats(
    addresses: list[int], counts: list[int], flows: list[Flow | None]
) -> list[int]:
    """Count a repeated string instruction once, however often it repeats itself."""
    counts = list(counts)
    for at, how in enumerate(flows):
        if how is None or not how.repeated or at + 1 == len(addresses):
            continue
        if addresses[at + 1] == addresses[at] + how.size:
            counts[at] = min(counts[at], counts[at + 1])
    return counts


def _joined(addresses: list[int], counts: list[int], flows: list[Flow | None]) -> list[bool]:
    """Whether each instruction always leads to the next, and nothing else does."""
    joined = [
        how is not None
        and how.straight
        and addresses[at + 1] == addresses[at] + how.size
        and counts[at + 1] == counts[at]
        for at, how in enumerate(flows[:-1])
    ]
    return [*joined, False]


def _detours(
    addresses: list[int], sizes: list[int], flows: list[Flow | None]
) -> Iterator[Detour | None]:
    """The detour at each instruction."""
    ends = [at + how.size if how else at for at, how in zip(addresses, flows, strict=True)]
    gaps = [
        range(end, start - TRAITS.jump_bytes + 1)
        for end, start in zip(ends, addresses[1:], strict=False)
        if start - end >= TRAITS.jump_bytes
    ]
    starts = [gap.start for gap in gaps]
    for address, size in zip(addresses, sizes, strict=True):
        if size >= TRAITS.jump_bytes:
            yield Detour(size)
        elif size >= TRAITS.short_jump_bytes:
            near = range(address + TRAITS.short_jump.start, address + TRAITS.short_jump.stop)
            yield _over_gap(
                address, size, gaps[max(0, bisect_left(starts, near.start) - 1) :], near
            )
        else:
            yield None


def _over_gap(address: int, size: int, gaps: Sequence[range], near: range) -> Detour | None:
    """A detour over the first bytes nearby that nothing executes."""
    for gap in gaps:
        first = max(gap.start, near.start)
        if first >= near.stop:
            return None
        if first in gap:
            return Detour(size, first - address)
    return None


def _places(detours: Sequence[Detour | None], joined: list[bool]) -> list[int]:
    """The index at which each is counted: its own, or the first possible of its block."""
    places: list[int] = []
    start = 0
    for at, more in enumerate(joined):
        if not more:
            block = range(start, at + 1)
            fits = [each for each in block if detours[each]]
            places += [each if detours[each] or not fits else fits[0] for each in block]
            start = at + 1
    return places


# -- counting by valgrind's callgrind

_SLOWER = 200.0  # callgrind takes 10 to 60 times as long as the program
_START_S = 60.0
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
    name, limit_s = Path(command.argv[0]).name, _SLOWER * wall_s + _START_S
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
