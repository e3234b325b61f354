"""The population from which a fault is drawn: windows of executed instructions.

A window of the golden run is single-stepped. The address of every executed instruction in scope is
recorded, so that faults can be drawn uniformly from these instructions. Code out of scope runs
natively. Meanwhile, every byte of the code in scope is replaced by a breakpoint instruction, which
catches every re-entry (return, callback, exception).
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import FaultError, TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.counted import CodeAt, CountedRun, CountedStop, Detour, Locate
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import InstructionFault, Strategy
from mavfi_cli.fi.tracer.image import Image, Location, Scope
from mavfi_cli.fi.tracer.inject import clean_step, instruction_at
from mavfi_cli.fi.tracer.tracee import DETOUR_COST, Tracee

_CHUNK = 16384
_BREAKPOINT = b"\xcc"  # the instruction
_STAGE_COST = 12  # a further stop costs about as much as 12 counted hits
_HORIZON = 1 << 20
_DRAWS = 10_000  # instructions without a suitable operand after which no more are drawn
_NEAR = 16  # instructions before the target that are tried as places for a detour


@dataclass(frozen=True, kw_only=True, eq=False)
class Segment:
    """One stepped window: its start, and the instructions that executed in it."""

    start: tuple[CountedStop, ...]  # empty: the program's entry point
    trace: NDArray[np.int64]  # (n,) addresses in order; a repeated string instruction is one entry

    @functools.cached_property
    def ranks(self) -> NDArray[np.int64]:
        """Execution number, from 1, of the instruction at each position; an array of shape (n,)."""
        order = np.argsort(self.trace, kind="stable")
        ordered = self.trace[order]
        fresh = np.r_[True, ordered[1:] != ordered[:-1]]
        starts = np.maximum.accumulate(np.where(fresh, np.arange(len(order)), 0))
        ranks = np.empty(len(order), np.int64)
        ranks[order] = np.arange(len(order)) - starts + 1
        return ranks


@dataclass(frozen=True, slots=True, kw_only=True)
class Stratum:
    """The windows that begin at one instruction; some of them were stepped."""

    segments: tuple[Segment, ...]
    windows_in_run: int  # number of all windows; the stepped ones are a sample
    marker: Location | None = None  # None: the start of the run
    detours: bool = True  # whether detours may count executions

    def without_detours(self) -> Stratum:
        """Return the same windows, with triggers that use no detours."""
        segments = (
            replace(segment, start=tuple(replace(stop, detour=None) for stop in segment.start))
            for segment in self.segments
        )
        return replace(self, segments=tuple(segments), detours=False)

    @property
    def instructions(self) -> float:
        """Number of executed instructions in all windows, estimated from the stepped ones."""
        return self.executed / len(self.segments) * self.windows_in_run

    @property
    def executed(self) -> int:
        """Number of executed instructions in scope in the stepped windows."""
        return sum(len(segment.trace) for segment in self.segments)

    @property
    def complete(self) -> bool:
        """True if every window of the run was stepped."""
        return len(self.segments) == self.windows_in_run

    def address(self, position: int) -> int:
        """Return the address of the executed instruction at `position`.

        Positions count the executed instructions of all segments, from 0.
        """
        segment, index = self._at(position)
        return int(segment.trace[index])

    def trigger(
        self, position: int, locate: Locate, code_at: CodeAt
    ) -> tuple[tuple[CountedStop, ...], int]:
        """Return the trigger for the executed instruction at `position`, and its number k.

        The number is that of the execution in its window, from 1. Positions are as for `address`.
        """
        return _plan_trigger(*self._at(position), locate, code_at if self.detours else None)

    def _at(self, position: int) -> tuple[Segment, int]:
        """Return the segment that contains a position, and the index in that segment."""
        for segment in self.segments:
            if position < len(segment.trace):
                return segment, position
            position -= len(segment.trace)
        raise IndexError(position)


class WindowTooLong(TargetError):
    """A window has too many instructions to be stepped."""

    def __init__(self, program: str, limit: int) -> None:
        super().__init__(
            program,
            f"executes more than {limit} instructions in scope, too many to single-step: name a "
            "function with shorter calls, or install valgrind to count those of a whole program",
        )


def record_window(
    tracee: Tracee,
    scope: Scope,
    *,
    limit: int,
    program: str,
    until_return: bool = False,
    markers: Sequence[int] = (),
    watch: Callable[[int], None] | None = None,
    reads_own_code: bool = True,
) -> NDArray[np.int64]:
    """Single-step one window of a run, and return the addresses that execute in scope, in order.

    The window begins at the current stop. It ends with the program or function, or at a marker.

    Args:
        tracee: the process, stopped at the start of the window.
        scope: the code whose instructions are recorded.
        until_return: the target is at a function's entry; the window ends when the function
            returns.
        markers: addresses in scope; the window ends before the next execution of any of them. It
            always contains the instruction at which the target is stopped.
        watch: called regularly with the number of instructions recorded since the last call.
        reads_own_code: the target may read its own code, so it is single-stepped. Otherwise it runs
            from breakpoint to breakpoint, which is several times faster.

    Raises:
        WindowTooLong: more than `limit` instructions in scope are executed.
    """
    stop = np.array([-1, 0, *markers], np.int64)
    if until_return:
        returns_to = tracee.memory.read(tracee.registers.sp, 8)
        stop[:2] = int.from_bytes(returns_to, "little"), tracee.registers.sp
    parts: list[NDArray[np.int64]] = []
    if tracee.registers.ip in markers:
        parts.append(np.array([tracee.registers.ip], np.int64))
        clean_step(tracee, instruction_at(tracee, tracee.registers.ip))
    total = len(parts)
    with contextlib.closing(_parts(tracee, scope, stop, reads_own_code)) as recorded:
        for part in recorded:
            parts.append(part)
            total += len(part)
            if watch is not None:
                watch(len(part))
            if total > limit:
                raise WindowTooLong(program, limit)
    return np.concatenate(parts) if parts else np.empty(0, np.int64)


def _parts(
    tracee: Tracee, scope: Scope, stop: NDArray[np.int64], reads_own_code: bool
) -> Generator[NDArray[np.int64], None, None]:
    from mavfi_cli.fi.tracer import stepper  # numba takes half a second to import

    blanket, spans = _Blanket(tracee, scope), scope.bounds
    ends = (int(stop[0]), *stop[2:].tolist())
    blocks = None if reads_own_code else stepper.Blocks(blanket.code, ends)
    trace = np.empty(_CHUNK, np.int64)
    try:
        while tracee.ended is None:
            target = tracee.tid, tracee.group
            tracee.registers.forget()
            if blocks is None:
                recorded, why, report = stepper.record_steps(*target, spans, trace, stop)
            else:
                recorded, why, report = blocks.record(*target, trace, stop)
            yield trace[:recorded].copy()
            if why == stepper.WINDOW_END:
                return
            if blocks is not None and why == stepper.NEW_BLOCK:
                blocks.add(tracee.registers.ip)
                continue
            if blocks is not None and why != stepper.FULL:
                if why != stepper.OUT_OF_SCOPE:  # `run_native` restores the code, too
                    blanket.uncover()
                blocks.forget_breakpoints()
            if why == stepper.OTHER_STATUS:
                tracee.handle(report, linux.SINGLESTEP)
            elif why == stepper.NEEDS_CARE:
                yield np.array([tracee.registers.ip], np.int64)
                clean_step(tracee, instruction_at(tracee, tracee.registers.ip))
            elif why == stepper.OUT_OF_SCOPE and not blanket.run_native(stop):
                return
    finally:
        if blocks is not None:
            blanket.uncover()


class _Blanket:
    """Covers the code in scope with breakpoint instructions while other code runs."""

    def __init__(self, tracee: Tracee, scope: Scope) -> None:
        self._tracee, self._scope = tracee, scope
        self.code = {span.start: tracee.memory.read(span.start, len(span)) for span in scope.spans}

    def run_native(self, stop: NDArray[np.int64]) -> bool:
        """Run natively up to code in scope. Return False if the program or function ends first."""
        tracee, registers, returns_to = self._tracee, self._tracee.registers, int(stop[0])
        with contextlib.ExitStack() as undo:
            if returns_to > 0 and returns_to not in self._scope:
                undo.callback(tracee.breakpoint_at(returns_to).close)
            undo.callback(self.uncover)
            for start, code in self.code.items():
                tracee.memory.write(start, _BREAKPOINT * len(code))
            while tracee.resume() is None:
                entered = registers.ip - len(_BREAKPOINT)
                if entered in self._scope:
                    registers.write("rip", entered)
                    return True
                if registers.ip == returns_to and registers.sp > stop[1]:
                    return False
            return False

    def uncover(self) -> None:
        """Restore the code."""
        for start, code in self.code.items() if self._tracee.ended is None else ():
            self._tracee.memory.write(start, code)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Way:
    """A possible trigger for one executed instruction: its stages, and its cost in counted hits."""

    cost: int
    stages: tuple[CountedStop, ...]


_cost = attrgetter("cost")


def _plan_trigger(
    segment: Segment, index: int, locate: Locate, code_at: CodeAt | None
) -> tuple[tuple[CountedStop, ...], int]:
    """Return the cheapest exact trigger for the executed instruction at `index` in a segment.

    Every counted hit costs the same. If many hits would be needed, the trigger first counts to a
    rarely executed instruction shortly before the target and then counts the target's executions,
    or it uses a detour.

    Args:
        code_at: returns 16 bytes of code at an address; None forbids detours.

    Returns:
        The trigger, and the target's execution number k in the segment.
    """
    target, k = locate(int(segment.trace[index])), int(segment.ranks[index])
    best = _Way(cost=k, stages=(CountedStop(target, k),))
    if best.cost > _STAGE_COST:
        best = min([best, *_anchored(segment, index, locate)], key=_cost)
    if best.cost > DETOUR_COST and code_at is not None:
        best = min([best, *_detoured(segment, index, locate, code_at)], key=_cost)
    return (*segment.start, *best.stages), k


def _anchored(segment: Segment, index: int, locate: Locate) -> Iterator[_Way]:
    """Yield the cheapest trigger that first stops at an earlier instruction, if it saves hits."""
    target, k = segment.trace[index], int(segment.ranks[index])
    first = max(0, index - _HORIZON)
    before = segment.trace[first:index] == target
    ranks = segment.ranks[first:index]
    after = 1 + np.cumsum(before[::-1])[::-1]
    cost = np.where(before, np.iinfo(np.int64).max, ranks + after)
    if len(cost) and int(cost.min()) + _STAGE_COST < k:
        yield _through(segment, first + int(np.argmin(cost)), index, locate)


def _detoured(segment: Segment, index: int, locate: Locate, code_at: CodeAt) -> Iterator[_Way]:
    """Yield a trigger with a detour at the target, or at the nearest earlier place with room."""

    def executions(address: int) -> int:
        return int(np.count_nonzero(segment.trace == address))

    for place in range(index, max(-1, index - _NEAR), -1):
        detour = Detour.at(int(segment.trace[place]), code_at, executions)
        if detour is not None:
            yield _through(segment, place, index, locate, detour)
            return


def _through(
    segment: Segment, place: int, index: int, locate: Locate, detour: Detour | None = None
) -> _Way:
    """Return the trigger that counts up to the instruction at `place`, then up to the target."""
    rank, target = int(segment.ranks[place]), segment.trace[index]
    stages = [CountedStop(locate(int(segment.trace[place])), rank, detour)]
    cost = rank if detour is None else min(rank, DETOUR_COST)
    if place < index:
        after = int(np.count_nonzero(segment.trace[place : index + 1] == target))
        stages.append(CountedStop(locate(int(target)), after))
        cost += after + _STAGE_COST
    return _Way(cost=cost, stages=tuple(stages))


def draw_fault(
    stratum: Stratum | CountedRun,
    plan: Strategy,
    rng: np.random.Generator,
    *,
    code_at: CodeAt,
    locate: Locate,
) -> InstructionFault:
    """Draw a fault uniformly from the executed instructions that have a suitable operand.

    If a drawn instruction has no operand that the fault model allows, another instruction is drawn.
    So all suitable instructions stay equally likely.

    Args:
        plan: a strategy whose rule is instruction-uniform.
        code_at: returns 16 bytes of code at an address.

    Raises:
        FaultError: no instruction in scope was executed, or none of many drawn ones has a suitable
            operand.
    """
    if not stratum.executed:
        raise FaultError("no instruction in scope was executed")
    for _ in range(_DRAWS):
        position = int(rng.integers(stratum.executed))
        address = stratum.address(position)
        instruction = decode(code_at(address), address)
        if instruction is None:
            continue
        following = decode(code_at(instruction.next_address), instruction.next_address)
        corruption = plan.draw_at(instruction, rng, following)
        if corruption is None:
            continue
        trigger, k = stratum.trigger(position, locate, code_at)
        return InstructionFault(
            trigger=trigger,
            execution=k,
            instruction=instruction.text,
            instruction_bytes=instruction.raw,
            corruption=corruption,
        )
    raise FaultError(
        f"none of {_DRAWS:,} drawn instructions has an operand that the fault model allows"
    )


def draw_fault_here(
    tracee: Tracee,
    image: Image,
    scope: Scope,
    plan: Strategy,
    rng: np.random.Generator,
    execution: int = 0,
) -> tuple[InstructionFault | None, str]:
    """Draw a fault in the instruction that the stopped thread is about to execute.

    Args:
        execution: execution number to record.

    Returns:
        The fault, or None and the reason why none was drawn.
    """
    here = tracee.registers.ip
    if tracee.registers.system_call is not None and not plan.in_system_calls:
        return None, f"inside system call {tracee.registers.system_call}"
    if here not in scope and not plan.whole_process:
        return None, f"outside the scope, in {image.locate(here).object}"
    instruction = instruction_at(tracee, here)
    following = None if instruction is None else instruction_at(tracee, instruction.next_address)
    corruption = None if instruction is None else plan.draw_at(instruction, rng, following)
    if instruction is None or corruption is None:
        return None, "no operand that the fault model allows"
    fault = InstructionFault(
        trigger=(CountedStop(image.locate(here), 1),),
        execution=execution,
        instruction=instruction.text,
        instruction_bytes=instruction.raw,
        corruption=corruption,
    )
    return fault, ""
