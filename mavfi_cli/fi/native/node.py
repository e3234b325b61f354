"""Profile and attack one kernel inside a long-running process (a node of a mission).

Both functions block while the node works, so the mission runs them in a thread of their own and
goes on sending the node its requests. They end with the node detached and running natively.

The node must be a child of the calling process or allow tracing (`PR_SET_PTRACER`). If it dies
while it is attached, the tracer hears of it first: take its end from the result, not from
`Popen.wait`.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi import record
from mavfi_cli.fi.native.breakpoints import ExecutionCounter, Mechanism
from mavfi_cli.fi.native.fault import InstructionFault, Stage
from mavfi_cli.fi.native.image import Image, Location, Regions, scope_of
from mavfi_cli.fi.native.inject import NOTHING, Followed, Injection, reach, strike
from mavfi_cli.fi.native.profile import Segment, record_window
from mavfi_cli.fi.native.tracee import Ended, Tracee, best_mechanism
from mavfi_cli.fi.native.tracer import TracerThread

Notice = Callable[[], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class InvocationProfile:
    """What one invocation of a kernel executed, with what is needed to draw from it."""

    segment: Segment
    image: Image
    code: tuple[tuple[int, bytes], ...]  # start address and bytes of the code in scope


@dataclass(frozen=True, slots=True, kw_only=True)
class Attack:
    """What came of a fault in a node."""

    injection: Injection | None  # None: the trigger was not reached, or null injection
    followed: Followed
    reason: str
    ended: Ended | None  # None: the node lives on, detached
    record: dict[str, Any]


def profile_invocation(
    pid: int,
    entry: Location,
    invocation: int,
    *,
    objects: tuple[str, ...],
    regions: Regions | None = None,
    inner: tuple[Stage, ...] = (),
    limit: int = 2_000_000,
    armed: Notice | None = None,
) -> InvocationProfile:
    """Step one invocation of a kernel in a fault-free node, or of a function inside it.

    A kernel of many million instructions is profiled by sample: count the calls of a function
    inside it (`count_executions`), draw some uniformly, and profile each with `inner`.

    Args:
        pid: the node, single-threaded as far as code in scope goes.
        entry: the kernel's entry.
        invocation: which one from now on, from 1.
        objects: in scope.
        regions: as `Image` takes them; may be in `objects`.
        inner: further stages after the kernel's entry; the last is a function's entry, and the
            window is that function's invocation.
        limit: refuse longer invocations.
        armed: called once the node runs towards the invocation.

    Raises:
        TracingForbidden: the operating system refuses.
        TargetError: the node ends before; WindowTooLong where the limit is reached.
    """
    tracee = Tracee.attach(pid)
    try:
        image = Image(pid, regions)
        scope = scope_of(image, objects)
        code = tuple((s.start, tracee.read_memory(s.start, len(s) + 16)) for s in scope.spans)
        start = (Stage(entry, invocation), *inner)
        if armed is not None:
            armed()
        _run_through(tracee, image, start)
        trace = record_window(tracee, scope, limit=limit, program=f"node {pid}", until_return=True)
    finally:
        if tracee.ended is None:
            tracee.detach()
    return InvocationProfile(segment=Segment(start=start, trace=trace), image=image, code=code)


def count_executions(
    pid: int,
    entry: Location,
    invocation: int,
    what: Sequence[Location],
    *,
    regions: Regions | None = None,
    armed: Notice | None = None,
) -> list[int]:
    """How often each of some instructions executes during one invocation of a kernel.

    Raises:
        TargetError: the node ends before.
    """
    tracee = Tracee.attach(pid)
    try:
        image = Image(pid, regions)
        if armed is not None:
            armed()
        _run_through(tracee, image, (Stage(entry, invocation),))
        return tracee.count_in_call([image.address(location) for location in what])
    finally:
        if tracee.ended is None:
            tracee.detach()


class EntryCounter:
    """Counts the executions of one instruction of a running node, which goes on meanwhile.

    Where the operating system does not count, a tracer stops at each; the count is right whenever
    the node has answered all the same, since it answers after its last stop.

    Args:
        pid: the node; closing the counter may end it.
        address: of the instruction.
    """

    def __init__(self, pid: int, address: int) -> None:
        self._pid, self._address, self._stops = pid, address, 0
        self._counter: ExecutionCounter | None = None
        self._tracer: TracerThread[None] | None = None
        if best_mechanism() is Mechanism.PERF:
            self._counter = ExecutionCounter(pid, address)
        else:
            self._tracer = TracerThread(self._count)
            self._tracer.await_armed()

    def read(self) -> int:
        """Executions since the counter was made."""
        return self._stops if self._counter is None else self._counter.read()

    def close(self) -> None:
        """Take the counter away, and with it a node that had to be traced."""
        if self._counter is not None:
            self._counter.close()
        if self._tracer is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)
            self._tracer.result()

    def _count(self, armed: Notice) -> None:
        tracee = Tracee.attach(self._pid)
        tracee.breakpoint_at(self._address)
        armed()
        while not isinstance(tracee.resume(), Ended):
            self._stops += tracee.registers.ip == self._address


def _run_through(tracee: Tracee, image: Image, stages: tuple[Stage, ...]) -> None:
    for stage in stages:
        if not tracee.run_to(image.address(stage.location), stage.count):
            raise TargetError(
                f"node {tracee.pid}", f"ended before execution {stage.count} of {stage.location}"
            )


def attack(
    pid: int,
    fault: InstructionFault,
    *,
    path: Path,
    regions: Regions | None = None,
    window: int = 64,
    armed: Notice | None = None,
    stopped: Callable[[Tracee], None] | None = None,
    leave_stopped: bool = False,
    **context: Any,
) -> Attack:
    """Apply one fault in a node; its record is on the disk before the node runs to the trigger.

    Args:
        pid: the node.
        fault: its trigger counts from now on.
        path: of the record.
        regions: as in `profile_invocation`.
        window: how many instructions a destination fault is followed.
        armed: called once the node runs towards the trigger.
        stopped: called at the stop, before the flip (to wait for a debugger, say).
        leave_stopped: let the node go stopped (SIGSTOP) after the flip, for a debugger.
        context: what else belongs in the record: kernel, stage, sampling rule, seed, scope.

    Raises:
        TracingForbidden: the operating system refuses.
        FaultError: another instruction is at the place.
    """
    tracee = Tracee.attach(pid)
    try:
        image = Image(pid, regions)
        planned = record.planned(fault, image, **context)
        record.write(path, planned)
        if armed is not None:
            armed()
        reason = reach(tracee, image, fault)
        injection, followed = None, NOTHING
        if not reason:
            if stopped is not None:
                stopped(tracee)
            injection, followed = strike(tracee, fault, window=window)
            reason = "" if injection is None else injection.reason
            if leave_stopped and tracee.ended is None:
                os.kill(pid, signal.SIGSTOP)
    finally:
        if tracee.ended is None:
            tracee.detach()
    done = record.completed(planned, injection, followed, not_injected_reason=reason)
    record.write(path, done)
    return Attack(
        injection=injection, followed=followed, reason=reason, ended=tracee.ended, record=done
    )
