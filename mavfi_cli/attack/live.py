"""Applies one fault in a process that keeps running: a node of a mission, or a user's program.

Call these functions in a thread of their own, because ptrace obeys only the thread that attached.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.attack.tracer_thread import Notice
from mavfi_cli.core.errors import FaultSpecError, TracingForbidden
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer import linux, record
from mavfi_cli.fi.tracer.fault import FaultModel, InstructionFault, Rule, Strategy
from mavfi_cli.fi.tracer.image import Image, Regions, Scope
from mavfi_cli.fi.tracer.inject import (
    NOTHING,
    Followed,
    Injection,
    clean_step,
    instruction_at,
    reach,
    strike,
)
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.fi.tracer.sampling import draw_fault_here
from mavfi_cli.fi.tracer.tracee import Tracee, threads_of
from mavfi_cli.spec.fault import UNIFORM, InstructionConfig

MOST_STEPS = 1000  # largest number of instructions from a moment to the fault
_WINDOW = 64  # instructions for which a fault is followed
# Longest time for which a thread is stepped to a fault, and for which the fault is then followed.
# The program runs in real time, and PX4 detects a missing companion after 0.5 s.
_STEPPED_S, _FOLLOWED_S = 0.15, 0.05
_AT_ONCE = 50  # instructions that are stepped between two checks of the clock
_LOOK_S, _SEARCH_S = 1e-3, 10.0  # interval of the checks for code in scope, and their total time


def mission_strategy(fault: InstructionConfig) -> Strategy:
    """Return the strategy by which a mission draws its instruction-level fault.

    Raises:
        UnknownName: A site, role, field, sampling rule or compatibility mode does not exist.
        FaultSpecError: The sampling rule is not repeatable, or a compatibility mode is combined
            with a fault model.
    """
    model = FaultModel.named(
        sites=fault.sites, roles=fault.roles, field=fault.field, bits=fault.bits
    )
    strategy = Strategy.of(fault.sampling, model, compat=fault.compat)
    if fault.compat is None and strategy.rule is not Rule.INSTRUCTION:
        raise FaultSpecError(
            f"sampling by {fault.sampling} cannot be repeated; a mission's sampling must be "
            f"{UNIFORM} (`mavfi kernels` accepts all rules)"
        )
    return strategy


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveAttack:
    """The result of one fault in a process that was already running."""

    injection: Injection | None  # None: the trigger was not reached, or null injection
    followed: Followed
    reason: str
    ended: Ended | None  # None: the process continues, detached
    record: FaultRecord
    name_symbol: Callable[[], str] = str  # reads the struck symbol, which the record lacks


def attack_live(
    pid: int,
    fault: InstructionFault,
    *,
    path: Path,
    regions: Regions | None = None,
    window: int = _WINDOW,
    armed: Notice = lambda: None,
    reached: Notice = lambda: None,
    leave_stopped: bool = False,
    **context: Any,
) -> LiveAttack:
    """Apply one fault in a running process, such as a mission's node, and let the process continue.

    The record is written to disk before the process runs to the trigger. The process must be a
    child of the calling one or allow tracing (`PR_SET_PTRACER`). If it dies while it is attached,
    the kernel notifies the tracer first: read its exit status from the result, not from
    `Popen.wait`.

    Args:
        window: largest number of instructions for which a destination fault is followed.
        armed: called just before the process runs to the trigger.
        reached: called when the process has stopped at the trigger.
        leave_stopped: detach with the process stopped (SIGSTOP) after the flip, for a debugger.
        context: further entries of the record: kernel, stage, sampling rule, seed, scope.

    Raises:
        TracingForbidden: the operating system does not allow tracing.
        FaultError: the process holds another instruction at the fault's location.
    """
    tracee = Tracee.attach(pid)
    try:
        image = Image(pid, regions)
        planned = record.planned(fault, image, **context)
        record.write(path, planned)
        armed()
        reason = reach(tracee, image, fault)
        injection, followed = None, NOTHING
        if not reason:
            reached()
            injection, followed = strike(tracee, fault, window=window)
            reason = "" if injection is None else injection.reason
            if leave_stopped and tracee.ended is None:
                os.kill(pid, signal.SIGSTOP)
    finally:
        if tracee.ended is None:
            tracee.detach()
    done = record.completed(planned, injection, followed, not_injected_reason=reason)
    record.write(path, done)
    return LiveAttack(
        injection=injection, followed=followed, reason=reason, ended=tracee.ended, record=done
    )


def attack_moment(
    pid: int,
    plan: Strategy,
    rng: np.random.Generator,
    *,
    path: Path,
    objects: tuple[str, ...] = (),
    function: str | None = None,
    null: bool = False,
    repeat: FaultRecord | None = None,
    **context: Any,
) -> LiveAttack:
    """Apply one fault in a running process, at once or soon after, and let the process continue.

    A thread is drawn with probability proportional to the CPU time that it has used, and stopped.
    Under the rule `INSTRUCTION` it is stepped, and the fault strikes the k-th executed instruction
    in scope; k is drawn uniformly from 1 to `MOST_STEPS`, and is smaller if the steps take too
    long. Under a time rule, the fault strikes where the thread is, or where a later check finds the
    thread in scope. The process runs in real time, so neither kind of fault is repeatable.

    The record has no symbol, because reading the symbols of a large object stops every other thread
    of the caller for too long. `LiveAttack.name_symbol` reads it afterwards.

    Args:
        objects: shared objects or executables in scope; empty for all that the process has loaded,
            except the interpreter of a Python program.
        function: only code that executes during calls of this function is in scope. The first
            thread that calls it is struck.
        null: leave out the flip.
        repeat: the record of an earlier fault; its instruction is struck again, at its first
            execution in any thread.
        context: further entries of the record.

    Raises:
        TracingForbidden: the operating system does not allow tracing.
        TargetError: the process does not exist.
        UnknownName: the process has no such object or function.
        BuildMismatch: the record comes from another build.
    """
    try:
        image = Image(pid)  # slow, so the process still runs meanwhile
        scope = image.scope(objects or _own_objects(pid, image))
    except PermissionError as error:  # the process may have forbidden it: PR_SET_DUMPABLE
        raise TracingForbidden.of(error) from None
    entry = None if function is None else image.address(image.function(function, scope.objects))
    if repeat is not None:
        record.require_same_build(repeat, image)
    planned, injection, followed = record.undrawn(**context), None, NOTHING
    record.write(path, planned)
    tracee = Tracee.attach(pid, thread=_drawn_thread(pid, rng))
    begun_s = time.perf_counter()
    fault: InstructionFault | None = None
    try:
        if repeat is None:
            fault, reason = _Search(tracee, image, scope, entry, plan, rng).fault()
        else:
            fault, reason = record.fault_of(repeat), ""
            if not tracee.run_any_to(image.address(fault.target)):
                fault, reason = None, "the program ended before the instruction"
        if fault is not None:
            fault = replace(fault, corruption=None) if null else fault
            record.write(path, record.planned(fault, image, names_symbol=False, **context))
            injection, followed = strike(tracee, fault, window=_WINDOW, patience_s=_FOLLOWED_S)
            reason = "" if injection is None else injection.reason
    except ProcessLookupError:  # it was killed while it was stopped
        reason = "the process ended"
    finally:
        thread = _thread_name(tracee.tid)
        if tracee.ended is None:
            tracee.detach()
    traced_s = round(time.perf_counter() - begun_s, 6)
    if fault is not None:
        planned = record.planned(fault, image, names_symbol=False, **context)
    done = record.completed(
        planned, injection, followed, not_injected_reason=reason, thread=thread, traced_s=traced_s
    )
    record.write(path, done)
    return LiveAttack(
        injection=injection, followed=followed, reason=reason, ended=tracee.ended, record=done,
        name_symbol=str if fault is None else partial(image.symbol, fault.target),
    )  # fmt: skip


def _own_objects(pid: int, image: Image) -> list[str]:
    """Return the names of the objects in a process, except the interpreter of a Python program."""
    program = Path(os.readlink(f"/proc/{pid}/exe")).name
    left_out = ("python", "libpython") if program.startswith("python") else ()
    names = (name for name in image.names if not name.startswith(left_out))
    return [name for name in names if image.find(name) is not None]


def _drawn_thread(pid: int, rng: np.random.Generator) -> int:
    """Draw the id of a thread, with probability proportional to the thread's CPU time.

    The CPU times come from proc_pid_schedstat(5).
    """
    threads = threads_of(pid)
    if not threads:
        return pid
    used = np.array([_cpu_ns(pid, thread) for thread in threads], float) + 1.0
    return int(threads[int(rng.choice(len(threads), p=used / used.sum()))])


def _cpu_ns(pid: int, thread: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/task/{thread}/schedstat").read_text().split()[0])
    except (OSError, ValueError, IndexError):  # it has ended, or the kernel reports no time
        return 0


def _thread_name(tid: int) -> str:
    try:
        return Path(f"/proc/{tid}/comm").read_text(errors="replace").strip()
    except OSError:  # it has ended
        return ""


@dataclass(slots=True)
class _Search:
    """Steps a stopped thread to a drawn execution of an instruction in scope."""

    tracee: Tracee
    image: Image
    scope: Scope
    entry: int | None  # of the only function whose calls are in scope
    plan: Strategy
    rng: np.random.Generator
    _caller: int = -1  # stack pointer at the function's entry; a higher one is its caller's
    _stepped_s: float = 0.0  # excludes system calls, in which the thread waits anyway

    def fault(self) -> tuple[InstructionFault | None, str]:
        """Run the thread to the instruction to strike, and draw the fault there.

        Returns:
            The fault and an empty string, or None and the reason why no fault was drawn.
        """
        by_steps = self.plan.rule is Rule.INSTRUCTION
        drawn = int(self.rng.integers(MOST_STEPS)) + 1 if by_steps else 0
        reason, count = "it executed no code in scope", 0
        until_s = time.monotonic() + _SEARCH_S
        while self.tracee.ended is None and time.monotonic() < until_s:
            if by_steps and not self._enter():
                continue
            late = self._stepped_s > _STEPPED_S
            # A restarted system call blocks, and a compiled step would block all of Python with it.
            waits = self.tracee.registers.system_call is not None
            if self.entry is None and count + 1 < drawn and not late and not waits:
                count += self._steps(min(drawn - 1 - count, _AT_ONCE))
                continue
            count += 1
            if count >= drawn or late:
                number = count if by_steps else 0
                fault, reason = draw_fault_here(
                    self.tracee, self.image, self.scope, self.plan, self.rng, number
                )
                if fault is not None:
                    return fault, ""
            if by_steps:
                self._step()
            else:
                self.tracee.run_for(self.plan.retry_s or _LOOK_S)
        return None, "the process ended" if self.tracee.ended is not None else reason

    def _enter(self) -> bool:
        """Let the thread run towards code in scope. Return True once it is there."""
        registers, back = self.tracee.registers, self._return_address()
        inside = registers.ip in self.scope
        if self.entry is not None and registers.sp > self._caller:
            self.tracee.run_any_to(self.entry)
            self._caller = self.tracee.registers.sp if self.tracee.ended is None else 0
            return self.tracee.ended is None
        if inside:
            return True
        if back in self.scope:  # called from the scope
            self.tracee.run_to(back)
        elif self.entry is not None:
            self._step()
        else:
            self.tracee.run_for(_LOOK_S)
        return False

    def _return_address(self) -> int:
        """Return the word on top of the stack, or 0 if it cannot be read."""
        try:
            return int.from_bytes(self.tracee.memory.read(self.tracee.registers.sp, 8), "little")
        except OSError:
            return 0

    def _steps(self, most: int) -> int:
        """Execute at most `most` instructions in scope, in a compiled loop. Return their number."""
        from mavfi_cli.fi.tracer import stepper  # numba takes half a second to import

        begun_s, tracee = time.perf_counter(), self.tracee
        tracee.registers.forget()
        executed, why, report = stepper.record_steps(
            tracee.tid, tracee.group, self.scope.bounds, np.empty(most, np.int64), stepper.NO_END
        )
        self._stepped_s += time.perf_counter() - begun_s
        if why == stepper.OTHER_STATUS:
            tracee.handle(report, linux.SINGLESTEP)
        elif why == stepper.NEEDS_CARE:
            self._step()
            executed += 1
        return executed

    def _step(self) -> None:
        begun_s, waits = time.perf_counter(), self.tracee.registers.system_call is not None
        instruction = instruction_at(self.tracee, self.tracee.registers.ip)
        clean_step(self.tracee, instruction)
        if not waits and (instruction is None or instruction.mnemonic != "syscall"):
            self._stepped_s += time.perf_counter() - begun_s
