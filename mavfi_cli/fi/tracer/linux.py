"""System calls for ptrace, process memory and time limits, independent of the architecture.

Request and option numbers: `<sys/ptrace.h>` of Linux; see ptrace(2), personality(2).
A stopped thread is identified by its thread id. ptrace obeys only the thread that attached.
"""

from __future__ import annotations

import ctypes
import functools
import os
import platform
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from mavfi_cli.core.errors import TracingForbidden
from mavfi_cli.core.processes import fork

PEEKUSER, POKEUSER = 3, 6
CONT, SINGLESTEP, DETACH, SYSCALL = 7, 9, 17, 24
GETSIGINFO, GETREGSET, SETREGSET = 0x4202, 0x4204, 0x4205
SEIZE, INTERRUPT, LISTEN = 0x4206, 0x4207, 0x4208

OPTION_EXITKILL = 1 << 20
TRACE_OPTIONS = (
    1 | (1 << 1) | (1 << 2) | (1 << 3) | (1 << 4)
)  # marked call stops, fork, vfork, clone, exec
CALL_STOP = signal.SIGTRAP | 0x80  # with PTRACE_O_TRACESYSGOOD
EVENT_FORK, EVENT_VFORK, EVENT_CLONE, EVENT_EXEC, EVENT_STOP = 1, 2, 3, 4, 128
WALL = 0x4000_0000
ADDR_NO_RANDOMIZE = 0x0040000

_libc = ctypes.CDLL(None, use_errno=True)
_ptrace = _libc.ptrace
_ptrace.restype = ctypes.c_long
_ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
_personality = _libc.personality
_personality.restype = ctypes.c_int
_personality.argtypes = [ctypes.c_ulong]

_SHORTEST_WAIT_S = 0.001  # of a timer
SUPPORTED = platform.system() == "Linux" and platform.machine() == "x86_64"


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


def request(number: int, tid: int, address: int = 0, data: int = 0) -> int:
    """Make one ptrace request and return its result as an unsigned integer.

    Raises:
        OSError: the request failed; it carries the errno.
    """
    ctypes.set_errno(0)
    result = int(_ptrace(number, tid, address, data))
    if result == -1:
        code = ctypes.get_errno()
        if code:
            raise OSError(code, os.strerror(code))
    return result & 0xFFFF_FFFF_FFFF_FFFF


def require_supported() -> None:
    """Raise an error if instruction-level injection does not support this machine.

    Raises:
        TracingForbidden: this is not x86-64 Linux.
    """
    if not SUPPORTED:
        raise TracingForbidden(
            "instruction-level injection",
            f"this machine is {platform.machine()} {platform.system()}",
            "use an x86-64 Linux machine, or source-level faults",
        )


def seize(tid: int, *, kill_with_tracer: bool) -> None:
    """Attach to a thread without stopping it, and to all threads and children that it starts.

    Raises:
        TracingForbidden: the operating system refuses; the message explains how to allow it.
        ProcessLookupError: the thread does not exist.
    """
    require_supported()
    options = TRACE_OPTIONS | (OPTION_EXITKILL if kill_with_tracer else 0)
    try:
        request(SEIZE, tid, 0, options)
    except PermissionError as error:
        raise TracingForbidden.of(error) from None


def require_permission() -> None:
    """Trace a process for a moment.

    Raises:
        TracingForbidden: The operating system refuses; the message explains how to allow it.
    """
    child = fork(_wait_to_be_killed)
    try:
        seize(child, kill_with_tracer=True)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _wait_to_be_killed() -> int:
    signal.pause()
    return 0


def get_registers(tid: int, note: int, buffer: ctypes.Array[ctypes.c_char]) -> int:
    """Fill `buffer` with the register set `note` of a stopped thread, and return its size in bytes.

    The size is the number of bytes that the kernel wrote.
    """
    vector = _IoVector(ctypes.addressof(buffer), len(buffer))
    request(GETREGSET, tid, note, ctypes.addressof(vector))
    return int(vector.length)


def set_registers(tid: int, note: int, data: bytes) -> None:
    """Write the register set `note` of a stopped thread.

    Raises:
        OSError: the kernel refuses a value (EINVAL, EIO).
    """
    buffer = ctypes.create_string_buffer(data, len(data))
    vector = _IoVector(ctypes.addressof(buffer), len(data))
    request(SETREGSET, tid, note, ctypes.addressof(vector))


class Memory:
    """The memory of a process, which can be read and written whatever its protection.

    It is opened on first use. Reading and writing raise OSError where nothing is mapped.
    """

    def __init__(self, pid: int) -> None:
        self._pid, self._file = pid, -1

    def _open(self) -> int:
        if self._file < 0:
            self._file = os.open(f"/proc/{self._pid}/mem", os.O_RDWR | os.O_CLOEXEC)
        return self._file

    def read(self, address: int, size: int) -> bytes:
        """Return `size` bytes at an address, or fewer if the mapped memory ends first."""
        return os.pread(self._open(), size, address)

    def write(self, address: int, data: bytes) -> None:
        """Write `data` at an address. The kernel first copies a page that is privately mapped."""
        os.pwrite(self._open(), data, address)

    def close(self) -> None:
        """Close the memory. The next read or write opens it again."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


@contextmanager
def fixed_addresses() -> Iterator[None]:
    """Disable address-space randomisation for programs that are started in this context."""
    before = int(_personality(0xFFFF_FFFF))
    if before == -1 or int(_personality(before | ADDR_NO_RANDOMIZE)) == -1:
        yield  # a sandbox may refuse; then only offsets repeat, not addresses
        return
    try:
        yield
    finally:
        _personality(before)


def share_processor(pid: int) -> None:
    """Pin the calling thread and the main thread of `pid` to the processor where `pid` ran last.

    Tracer and target alternate at every step, and stepping is twice as fast if they share one
    processor. Nothing unpins them, so call this only in a thread, and for a process, created for
    this purpose.
    """
    stat = Path(f"/proc/{pid}/stat").read_text()
    processor = int(stat.rpartition(")")[2].split()[36])  # field 39, proc_pid_stat(5)
    for tid in (0, pid):
        os.sched_setaffinity(tid, [processor])


def cpu_time_s(pid: int) -> float:
    """Return the CPU time, in seconds, of all threads of a process, or 0 if it has ended.

    The clock id encoding is that of clock_getcpuclockid(3) on Linux.
    """
    try:
        return time.clock_gettime((~pid << 3) | 2)
    except OSError:
        return 0.0


@dataclass(frozen=True, slots=True)
class Status:
    """One report of waitpid about one thread."""

    tid: int
    raw: int

    @property
    def stopped(self) -> bool:
        """True if the thread is stopped and waits for the tracer."""
        return os.WIFSTOPPED(self.raw)

    @property
    def ended(self) -> bool:
        """True if the thread has ended."""
        return os.WIFEXITED(self.raw) or os.WIFSIGNALED(self.raw)

    @property
    def signal(self) -> int:
        """Number of the signal at which the thread stopped."""
        return os.WSTOPSIG(self.raw)

    @property
    def event(self) -> int:
        """Number of the ptrace event at which the thread stopped, or 0 for any other stop."""
        return self.raw >> 16

    @property
    def trapped(self) -> bool:
        """True if the stop is a SIGTRAP that is not a ptrace event."""
        return self.stopped and self.event == 0 and self.signal == signal.SIGTRAP


def wait(tid: int) -> Status:
    """Wait for the next report about one thread, or about any thread if `tid` is -1.

    Raises:
        ChildProcessError: there is no thread to wait for.
    """
    stopped, raw = os.waitpid(tid, WALL)
    return Status(stopped, raw)


class ProcessTimer:
    """A timer that sends a signal to one process; leaving its context cancels it.

    It fires when the process has used `cpu_s` of CPU time since the timer was set, or when
    `wall_s` has passed, whichever comes first; None sets no limit. `fired` is true from then on. If
    the timer kills a stopped process, the next request to that process fails; the context ends
    then, without an error.
    """

    def __init__(
        self, pid: int, number: signal.Signals, *, cpu_s: float | None, wall_s: float | None
    ) -> None:
        self.fired = False
        self._signal = number
        self._process = os.pidfd_open(pid)
        used = functools.partial(cpu_time_s, pid)  # with threads, faster than the wall clock
        clocks = ((used, cpu_s, os.cpu_count() or 1), (time.monotonic, wall_s, 1))
        self._ends = [(clock, clock() + s, rate) for clock, s, rate in clocks if s is not None]
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> ProcessTimer:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        self._cancelled.set()
        self._thread.join()
        os.close(self._process)
        return self.fired and kind is ProcessLookupError

    def _watch(self) -> None:
        while (left := self._left_s()) > 0:
            if self._cancelled.wait(min(max(left, _SHORTEST_WAIT_S), threading.TIMEOUT_MAX)):
                return
        self.fired = True
        try:
            signal.pidfd_send_signal(self._process, self._signal)
        except ProcessLookupError:
            self.fired = False  # the process has ended

    def _left_s(self) -> float:
        """Return a lower bound on the remaining wall-clock time, in seconds. It may be negative."""
        return min((end_s - clock()) / rate for clock, end_s, rate in self._ends)
