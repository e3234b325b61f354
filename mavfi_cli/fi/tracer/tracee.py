"""One traced process: attach, stop exactly, step, resume, and report how it ended.

Every thread and child of the process is traced, so that none outlives the tracer. The *target*
thread is stopped and corrupted; the others keep running. Every step waits for the kernel's
report. Call all methods from the thread that attached.

Two mechanisms stop exactly before the k-th execution of an instruction. The better one is `PERF`:
the kernel counts the hits of a hardware breakpoint and raises SIGTRAP on the k-th
(`perf_event_open` with `sigtrap`, Linux 5.13, perf_event_open(2)). It needs no performance counter,
so it works in virtual machines. With `DEBUG`, the tracer writes the debug register itself and
counts, with one stop per hit.

Both take microseconds per hit. Many hits are therefore counted in the target itself, by a detour,
provided that no jump leads into the middle of the instructions at the counted address. By the time
the caller sees the stop, the detour has been removed and the memory restored.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.counted import Detour
from mavfi_cli.fi.tracer.linux import ProcessTimer
from mavfi_cli.fi.tracer.registers import CALL_ARGUMENTS, Registers

DETOUR_COST = 20  # hits at which a detour becomes faster; making one costs about 15 hits
_DISTANCES = (1 << 30, 1 << 24, 1 << 20)  # distance of a detour's pages from the code, bytes
_PAGES_BYTES = 8192
# System calls.
CLOSE, SENDTO = 3, 44
_MMAP, _MUNMAP, _CLONE, _PERF_EVENT_OPEN = 9, 11, 56, 298
_DUP2, _SOCKET, _CONNECT = 33, 41, 42
_CLONE_PARENT = 0x8000
_LOOK_S, _POLL_S = 1e-3, 5e-4
_SYSTEM_CALL = b"\x0f\x05"  # the instruction
_NO_CALL = (1 << 64) - 1  # replaces the number of a system call that has begun, to skip it
_FREE = 512  # bytes below the stack pointer that no function uses, with room for a socket address
_ALL_ACCESS, _PRIVATE_FIXED, _NO_FILE = 7, 0x10_0022, (1 << 64) - 1  # mmap, MAP_FIXED_NOREPLACE

_TYPE_BREAKPOINT, _EXECUTE, _LENGTH, _CLOSE_ON_EXEC = 5, 4, 8, 8
_DISABLED_AT_EXEC_END = 1 << 36 | 1 << 37  # remove_on_exec, sigtrap
_IN_NEW_THREADS = 1 << 1 | 1 << 35  # inherit, inherit_thread
_USER_ONLY = 1 << 5 | 1 << 6  # exclude_kernel, exclude_hv
_ATTRIBUTES = struct.Struct("<IIQQQQQIIQQ56x")  # perf_event_attr, version 7: 128 bytes

_DEBUG_REGISTERS = 848  # offset of debug register 0 in `struct user`
_TAKEN = 3 | 0xF << 16  # bits of debug register 7 for debug register 0

_libc = ctypes.CDLL(None, use_errno=True)


class Mechanism(Enum):
    """A mechanism that counts executions and stops at one of them."""

    PERF = "perf"
    DEBUG = "debug-registers"

    @classmethod
    def best(cls) -> Mechanism:
        """Return the best mechanism that this machine allows."""
        return cls.PERF if perf_allowed() is None else cls.DEBUG

    @property
    def counters(self) -> int:
        """Largest number of addresses whose executions are counted in one run."""
        return 4 if self is Mechanism.PERF else 1  # Intel SDM volume 3, section 18.2


def _open_event(tid: int, address: int, period: int, *, inherited: bool = False) -> int:
    linux.require_supported()
    extra = (_DISABLED_AT_EXEC_END if period else 0) | (_IN_NEW_THREADS if inherited else 0)
    attributes = _ATTRIBUTES.pack(
        _TYPE_BREAKPOINT, 128, 0, period, 0, 0, _USER_ONLY | extra, 0, _EXECUTE, address, _LENGTH,
    )  # fmt: skip
    flags = ctypes.c_ulong(_CLOSE_ON_EXEC)
    fd = int(_libc.syscall(_PERF_EVENT_OPEN, attributes, tid, -1, -1, flags))
    if fd < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return fd


class _DebugBreakpoint:
    """Debug register 0 of a *stopped* thread, set to trap before every execution of `address`.

    Intel SDM volume 3, section 18.2.
    """

    def __init__(self, tid: int, address: int) -> None:
        self._tid = tid
        self._enable(0)
        self._poke(0, address)
        self._enable(1)  # enable it for the thread; zeros mean type execute, length 1

    def close(self) -> None:
        """Remove the breakpoint; the thread must be stopped or gone."""
        with contextlib.suppress(ProcessLookupError):
            self._enable(0)

    def _enable(self, bits: int) -> None:
        others = linux.request(linux.PEEKUSER, self._tid, _DEBUG_REGISTERS + 8 * 7) & ~_TAKEN
        self._poke(7, others | bits)

    def _poke(self, register: int, value: int) -> None:
        linux.request(linux.POKEUSER, self._tid, _DEBUG_REGISTERS + 8 * register, value)


class ExecutionCounter:
    """Counts the executions of one instruction.

    Args:
        stop_at: the thread traps before this execution; 0: never.
        inherited: threads that this thread starts get counters of their own.
    """

    def __init__(
        self, tid: int, address: int, stop_at: int = 0, *, inherited: bool = False
    ) -> None:
        self._fd = _open_event(tid, address, stop_at, inherited=inherited)

    def read(self) -> int:
        """Return the number of executions since the counter was created.

        The counter can be read even after the thread has ended.
        """
        return int.from_bytes(os.read(self._fd, 8), "little")

    def close(self) -> None:
        """Remove the counter and its breakpoint."""
        os.close(self._fd)


def perf_allowed() -> str | None:
    """Return the reason why this machine refuses counted breakpoints, or None if it allows them."""
    try:
        os.close(_open_event(0, 0x1000, 1_000_000))
    except OSError as error:
        return str(error)
    return None


_TRAP_PERF = 6
# TRAP_BRKPT, _TRACE, _HWBKPT, _PERF, SI_KERNEL
_TRACER_TRAPS = frozenset((1, 2, 4, _TRAP_PERF, 0x80))
_NOT_FROM_OTHERS = 0x2000_0000  # __WNOTHREAD: only tracees and children of this thread
_ANY_CHILD = -1


def _signal_code(tid: int) -> int:
    """Return the `si_code` of the signal at which a thread has stopped."""
    buffer = (ctypes.c_int * 32)()
    linux.request(linux.GETSIGINFO, tid, 0, ctypes.addressof(buffer))
    return int(buffer[2])


def _signal_of(status: linux.Status) -> int:
    """Return the signal to deliver to a stopped thread, or 0 if none or only the tracer's own."""
    if not status.stopped or status.event:
        return 0
    ours = status.signal == signal.SIGTRAP and _signal_code(status.tid) == _TRAP_PERF
    return 0 if ours else status.signal


def threads_of(pid: int) -> list[int]:
    """Return the thread ids of a process in ascending order; empty if the process has ended."""
    try:
        return sorted(int(name) for name in os.listdir(f"/proc/{pid}/task"))
    except (FileNotFoundError, ProcessLookupError):
        return []


@dataclass(slots=True)
class Tracee:
    """A traced process whose target thread is stopped between calls."""

    pid: int
    tid: int
    group: int  # argument of waitpid: minus the process group, the process, or -1 for any child
    mechanism: Mechanism = Mechanism.PERF
    ended: Ended | None = None
    signals: list[int] = field(default_factory=list)  # signals delivered to the process, in order
    registers: Registers = field(init=False)
    memory: linux.Memory = field(init=False)
    _pending_signal: int = 0
    _interrupting: bool = False
    _expecting_alarm: bool = False

    def __post_init__(self) -> None:
        self.registers, self.memory = Registers(self.tid), linux.Memory(self.pid)

    @classmethod
    def attach(
        cls, pid: int, *, thread: int | None = None, mechanism: Mechanism | None = None,
        alone: bool = False,
    ) -> Tracee:  # fmt: skip
        """Attach to every thread of a running process and stop one of them, the target.

        The attaching thread must have no other child that other code waits for.

        Args:
            thread: id of the target; None for the main thread.
            mechanism: how executions are counted; by default the best that is allowed.
            alone: the process has only one thread. The attaching thread may trace others as well.

        Raises:
            TracingForbidden: the operating system does not allow tracing.
            TargetError: the process does not exist or has ended.
        """
        seized: set[int] = set()
        while missing := [t for t in threads_of(pid) if t not in seized]:
            for each in missing:
                # The thread may have ended between the listing and the attach.
                with contextlib.suppress(ProcessLookupError):
                    linux.seize(each, kill_with_tracer=True)
                seized.add(each)
        if not seized:
            raise TargetError(f"process {pid}", "does not exist")
        group = pid if alone else _ANY_CHILD
        target = pid if thread is None or thread not in seized else thread
        tracee = cls(pid, target, group, mechanism or Mechanism.best())
        try:
            tracee.interrupt()
        except ProcessLookupError:  # it has ended since
            tracee.detach()
            raise TargetError(f"process {pid}", "has ended") from None
        return tracee

    def interrupt(self) -> None:
        """Stop the running target thread wherever it is, without disturbing a system call."""
        linux.request(linux.INTERRUPT, self.tid)
        self._interrupting = True
        self._await()
        self._interrupting = False

    def step(self) -> Ended | None:
        """Execute one instruction of the target, or one iteration of a repeated string instruction.

        Returns None, or how the process ended.
        """
        return self._go(linux.SINGLESTEP)

    def resume(self) -> Ended | None:
        """Run until the tracer's trap stops the target or the process ends.

        Returns None, or how the process ended.
        """
        return self._go(linux.CONT)

    def resume_until_alarm(self, alarm: ProcessTimer) -> Ended | None:
        """Run until `alarm` sends its SIGTRAP. Return None, or how the process ended.

        The signal is not delivered to the program.
        """
        self._expecting_alarm = True
        try:
            with alarm:
                self.resume()
        finally:
            self._expecting_alarm = False
        return self.ended

    def run_to(self, address: int, count: int = 1, detour: Detour | None = None) -> bool:
        """Run until the target thread is about to execute `address` for the `count`-th time.

        If the thread is already stopped before an execution of `address`, that one is the first.

        Args:
            detour: the location of a detour that can count the executions.

        Returns:
            False if the process ended first.
        """
        if count >= DETOUR_COST and detour is not None:
            detoured = self._run_to_detoured(address, count, detour)
            if detoured is not None:
                return detoured
        self.registers.rearm()
        with contextlib.closing(self.breakpoint_at(address, count)) as trap:
            left = count if isinstance(trap, _DebugBreakpoint) else 1
            while left:
                if self.resume() is not None:
                    return False
                left -= self.registers.ip == address
            return True

    def run_any_to(self, address: int) -> bool:
        """Run until any thread is about to execute `address`. That thread becomes the target.

        With the mechanism `DEBUG`, only the current target thread is awaited.

        Returns:
            False if the process ended first.
        """
        if self.registers.ip == address:
            return True
        with contextlib.ExitStack() as counters:
            for thread in threads_of(self.pid):
                try:
                    counter = ExecutionCounter(thread, address, 1, inherited=True)
                except OSError:  # not allowed, or the thread has ended
                    continue
                counters.callback(counter.close)
            if self.mechanism is Mechanism.DEBUG:
                return self.run_to(address)
            self.registers.forget()
            with contextlib.suppress(ProcessLookupError):
                linux.request(linux.CONT, self.tid, 0, self._take_signal())
            while self.ended is None:
                status = self._wait()
                if status.ended:
                    self._note_end(status)
                elif status.trapped and (here := Registers(status.tid)).ip == address:
                    self.tid, self.registers = status.tid, here
                    return True
                else:
                    self._continue(status, linux.CONT)
            return False

    def run_for(self, duration_s: float) -> Ended | None:
        """Let the stopped target run for a wall-clock time, then stop it wherever it is.

        Returns None, or how the process ended.
        """
        self.registers.forget()
        with contextlib.suppress(ProcessLookupError):  # killed at a stop: its end is reported next
            linux.request(linux.CONT, self.tid, 0, self._take_signal())
        until_s = time.monotonic() + duration_s
        while self.ended is None and (left_s := until_s - time.monotonic()) > 0.0:
            status = self._wait(os.WNOHANG)
            if not status.tid:
                time.sleep(min(left_s, _POLL_S))
            elif status.ended:
                self._note_end(status)
            else:
                self._continue(status, linux.CONT)
        if self.ended is None:
            with contextlib.suppress(ProcessLookupError):
                self.interrupt()
        return self.ended

    def count_to_end(self, *addresses: int) -> list[int]:
        """Run to the end of the program and count the executions of each address on the way.

        Args:
            addresses: at most as many as `Mechanism.counters`.
        """
        self.registers.rearm()
        with contextlib.ExitStack() as open_ones:
            if self.mechanism is Mechanism.PERF:
                counters = [ExecutionCounter(self.tid, address) for address in addresses]
                for counter in counters:
                    open_ones.callback(counter.close)
                while self.resume() is None:
                    pass
                return [counter.read() for counter in counters]
            (address,), count = addresses, 0
            open_ones.callback(self.breakpoint_at(address).close)
            while self.resume() is None:
                count += self.registers.ip == address
            return [count]

    def breakpoint_at(self, address: int, count: int = 1) -> ExecutionCounter | _DebugBreakpoint:
        """Set a breakpoint before execution `count` of the instruction at `address`.

        With the mechanism `DEBUG`, the breakpoint stops at every execution.
        """
        if self.mechanism is Mechanism.PERF:
            try:
                return ExecutionCounter(self.tid, address, count)
            except OSError:
                self.mechanism = Mechanism.DEBUG
        return _DebugBreakpoint(self.tid, address)

    def await_call(self) -> None:
        """Let the stopped process run until it waits in a system call, and stop it there."""
        while self.registers.system_call is None:
            self.run_for(_LOOK_S)

    def fork(self) -> Tracee:
        """Fork the stopped process, which must have been attached with `alone` set.

        The fork has the same registers and memory, and waits in the same system call. It has
        the same parent as the process.

        Raises:
            OSError: no memory is left, or no further process is allowed.
        """
        before, here = self.registers.general(), self.registers.ip
        code = self.memory.read(here, len(_SYSTEM_CALL))
        pid = self._checked_call(_CLONE, _CLONE_PARENT | signal.SIGCHLD, 0, 0, 0, 0)
        linux.wait(pid)  # it has not executed anything
        fork = Tracee(pid, pid, pid, self.mechanism)
        fork.memory.write(here, code)
        fork.registers.write_general(before)
        return fork

    def run_to_call(self, number: int, descriptor: int) -> list[tuple[int, ...]]:
        """Run until system call `number` on a file descriptor begins, or the process ends.

        Returns:
            Number and arguments of each system call on the way, including that one.
        """
        calls, entering = list[tuple[int, ...]](), False
        while self.ended is None:
            self.registers.forget()
            with contextlib.suppress(ProcessLookupError):  # killed at a stop
                linux.request(linux.SYSCALL, self.tid, 0, self._take_signal())
            status = self._wait()
            if status.ended:
                self._note_end(status)
            elif status.event == 0 and status.signal == linux.CALL_STOP:
                entering = not entering
                if entering:
                    call = self.registers.system_call or 0
                    given = map(self.registers.read, CALL_ARGUMENTS)
                    calls.append((call, *given))
                    if calls[-1][:2] == (number, descriptor):
                        break
            elif status.event == 0:
                self._pending_signal = status.signal
        return calls

    def system_call(self, number: int, *arguments: int) -> int:
        """Make the stopped target execute a system call, and return the call's result.

        Afterwards, the target has the same state as before.
        """
        before, here = self.registers.general(), self.registers.ip
        code = self.memory.read(here, len(_SYSTEM_CALL))
        self.memory.write(here, _SYSTEM_CALL)
        names = ("rax", *CALL_ARGUMENTS[: len(arguments)])
        self.registers.write_together(dict(zip(names, (number, *arguments), strict=True)))
        self.step()
        result = self.registers.read("rax")
        self.memory.write(here, code)
        self.registers.write_general(before)
        return result

    def _checked_call(self, number: int, *arguments: int) -> int:
        """Make the stopped target execute a system call, and return the result.

        Raises:
            OSError: the system call failed.
        """
        result = self.system_call(number, *arguments)
        if result >> 63:
            code = (1 << 64) - result
            raise OSError(code, os.strerror(code))
        return result

    def step_back(self) -> None:
        """Skip the system call at which `run_to_call` stopped, and go back to its instruction."""
        before, call = self.registers.general(), self.registers.read("orig_rax")
        self.registers.write("orig_rax", _NO_CALL)
        linux.request(linux.SYSCALL, self.tid)
        linux.wait(self.tid)
        self.registers.write_general(before)
        start = self.registers.ip - len(_SYSTEM_CALL)
        self.registers.write_together({"rip": start, "rax": call})

    def connect(self, descriptor: int, address: bytes) -> None:
        """Replace the target's socket `descriptor` with a stream socket connected to `address`.

        The address is that of a Unix socket.

        Raises:
            OSError: the operating system refuses one of the system calls.
        """
        data = socket.AF_UNIX.to_bytes(2, sys.byteorder) + address
        place = self.registers.sp - _FREE
        kept = self.memory.read(place, len(data))
        self.memory.write(place, data)
        connected = self._checked_call(_SOCKET, socket.AF_UNIX, socket.SOCK_STREAM, 0)
        self._checked_call(_CONNECT, connected, place, len(data))
        self._checked_call(_DUP2, connected, descriptor)
        self._checked_call(CLOSE, connected)
        self.memory.write(place, kept)

    def detach(self) -> None:
        """Let the process and its children continue untraced. If it has ended, record how.

        The target thread must be stopped. Even a thread that no longer appears in its process, such
        as a killed one, is awaited, because Linux reports the main thread's end last.
        """
        self.memory.close()
        while self.ended is None and (left := self._traced() - {self.tid}):
            for thread in list(left):
                try:
                    linux.request(linux.INTERRUPT, thread)
                except ProcessLookupError:  # it is gone, and nothing will be reported
                    left.discard(thread)
            while left and self.ended is None:
                status = self._wait()
                left.discard(status.tid)
                if status.ended:
                    self._note_end(status)
                elif status.tid != self.tid:
                    with contextlib.suppress(ProcessLookupError):
                        linux.request(linux.DETACH, status.tid, 0, _signal_of(status))
        if self.ended is None:
            try:
                linux.request(linux.DETACH, self.tid, 0, self._take_signal())
            except ProcessLookupError:  # it has been killed
                self._await_end()

    def _traced(self) -> set[int]:
        """Return the threads that the calling thread traces, in the process and its children."""
        if self.group == self.pid:
            return {self.tid}
        line = f"TracerPid:\t{threading.get_native_id()}\n".encode()

        def traced(folder: str) -> bool:
            try:
                with open(f"{folder}/status", "rb") as status:
                    return line in status.read()
            except OSError:  # it has ended
                return False

        # Check processes first: there may be many threads, and the target is stopped meanwhile.
        processes = [int(pid) for pid in os.listdir("/proc") if pid.isdigit()]
        return {
            thread
            for pid in processes
            if traced(f"/proc/{pid}")
            for thread in threads_of(pid)
            if traced(f"/proc/{pid}/task/{thread}")
        }

    def kill(self) -> Ended:
        """Kill the process, wait for its end, and return how it ended.

        If we started the process, the whole process group is killed and awaited.
        """
        if self.ended is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            self._await_end()
        if self.group < _ANY_CHILD:
            self._kill_descendants()
        assert self.ended is not None
        return self.ended

    def _kill_descendants(self) -> None:
        """Kill the process group of a program that we started, and wait for its end."""
        try:
            os.killpg(-self.group, signal.SIGKILL)
            while True:
                os.waitpid(self.group, linux.WALL | _NOT_FROM_OTHERS)
        except (ProcessLookupError, ChildProcessError):
            return

    # -- waiting

    def _go(self, how: int) -> Ended | None:
        self.registers.forget()
        with contextlib.suppress(ProcessLookupError):  # killed at a stop: its end is reported next
            linux.request(how, self.tid, 0, self._take_signal())
        return self._await(how)

    def _take_signal(self) -> int:
        number, self._pending_signal = self._pending_signal, 0
        if number:
            self.signals.append(number)
        return number

    def _await(self, how: int = linux.CONT) -> Ended | None:
        """Handle reports until the target thread stops for the caller or the process ends."""
        return self.handle(self._wait(), how)

    def handle(self, status: linux.Status, how: int) -> Ended | None:
        """Handle a report and those after it, until the target stops for the caller or ends.

        Args:
            how: the request that resumes the target after a stop that the caller does not await.
        """
        while True:
            if status.ended:
                if self._note_end(status):
                    return self.ended
            elif status.tid == self.tid:
                if self._trapped(status):
                    return None
                self._continue(status, how)
            else:
                self._continue(status, linux.CONT)
            status = self._wait()

    def _wait(self, options: int = 0) -> linux.Status:
        """Wait for a report and return it. With WNOHANG, thread 0 means that there is none yet."""
        stopped, raw = os.waitpid(self.group, linux.WALL | _NOT_FROM_OTHERS | options)
        return linux.Status(stopped, raw)

    def _note_end(self, status: linux.Status) -> bool:
        if status.tid != self.pid:
            return False
        self.memory.close()
        self.ended = Ended.of(os.waitstatus_to_exitcode(status.raw))
        return True

    def _await_end(self) -> None:
        while self.ended is None:
            try:
                status = self._wait()
            except ChildProcessError:
                self.ended = Ended(exit_code=None, signal=signal.SIGKILL)
                return
            if status.ended:
                self._note_end(status)
            else:
                self._continue(status, linux.CONT)

    def _trapped(self, status: linux.Status) -> bool:
        """Return True if the caller awaits this stop of the target; False if it must go on."""
        if status.event == linux.EVENT_STOP:
            return self._interrupting
        if status.trapped:
            code = _signal_code(self.tid)
            sent = self._expecting_alarm and code <= 0  # sent by a process
            if sent or code in _TRACER_TRAPS:
                return True
        if self._interrupting:
            # Another stop, such as the end of an exec, came before the interrupt, which Linux
            # then drops. A signal is delivered when the thread continues.
            self._pending_signal = status.signal if status.event == 0 else 0
            self._interrupting = False
            return True
        return False

    def _continue(self, status: linux.Status, how: int) -> None:
        """Resume a thread from a stop that no caller awaits, and deliver its signal, if any."""
        if status.event == linux.EVENT_STOP and status.signal != signal.SIGTRAP:
            how, number = linux.LISTEN, 0  # group-stop: stay stopped until SIGCONT
        else:
            number = _signal_of(status)
        if number:
            self.signals.append(number)
        # If it was killed meanwhile, its end is reported next.
        with contextlib.suppress(ProcessLookupError):
            linux.request(how, status.tid, 0, number)

    # -- counted stops

    def _run_to_detoured(self, address: int, count: int, detour: Detour) -> bool | None:
        """Run to execution `count` of `address`, which a detour counts.

        Returns:
            False if the program ended first, None if no detour can be made here.
        """
        if address < self.registers.ip < address + detour.size:
            return None
        pages = self._map_near(address)
        if pages is None:
            return None
        code = self.memory.read(address, detour.size)
        way = detour.code(code, address, pages, count)
        if way is None:
            self.system_call(_MUNMAP, pages, _PAGES_BYTES)
            return None
        replaced = {place: self.memory.read(place, len(jump)) for place, jump in way.jumps.items()}
        self._write({**way.pages, **way.jumps})
        while self.resume() is None:
            if self.registers.ip == way.stop:
                self._write(replaced)
                self.registers.write("rip", address)
                self.system_call(_MUNMAP, pages, _PAGES_BYTES)
                return True
        return False

    def _write(self, pieces: Mapping[int, bytes]) -> None:
        for address, data in pieces.items():
            self.memory.write(address, data)

    def _map_near(self, address: int) -> int | None:
        """Map pages within reach of a jump from `address`, and return where they are.

        They are away from any later heap or library mappings. Returns None if no place is free.
        """
        for distance in _DISTANCES:
            pages = (address - distance) & ~4095
            if pages > 0 and self.system_call(
                _MMAP, pages, _PAGES_BYTES, _ALL_ACCESS, _PRIVATE_FIXED, _NO_FILE, 0
            ) == pages:  # fmt: skip
                return pages
        return None
