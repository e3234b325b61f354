"""Starts a program under the tracer, and watches the system calls of one run.

The program is stopped at its first instruction or its entry point. The system calls of a fault-free
run show whether it starts threads or other programs (which are not followed), which files it
writes, and why it may have failed.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.registers import CALL_ARGUMENTS
from mavfi_cli.fi.tracer.tracee import Mechanism, Tracee

# The shell reports that it is running (its own exec is over), then waits for a line, so that the
# tracer can attach before the program starts. A corrupted program leaves no core file, and its
# output (in blocks of 512 bytes) and memory (in KiB) are limited. Without PWD and OLDPWD, its
# environment does not depend on the working directory.
_LAUNCHER = (
    'ulimit -c 0; ulimit -f 2097152; ulimit -v "$1"; echo >&3 && read -r go <&3 && '
    'cd -- "$2" && shift 2 && unset PWD OLDPWD && exec "$@" 3<&-'
)


MEMORY_BYTES = 2 << 30
_AT_ENTRY, _AT_RANDOM = 9, 25
_KEPT = frozenset(("HOME", "LANG", "LANGUAGE", "LD_LIBRARY_PATH", "PATH", "TZ"))
_KEPT_BEGINNINGS = ("LC_", "OMP_", "OPENBLAS_", "MKL_")


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """A program to start with fixed addresses, a fixed environment and output in files."""

    argv: tuple[str, ...]
    directory: Path
    environment: tuple[tuple[str, str], ...]
    stdin: Path = Path(os.devnull)
    memory_bytes: int | None = MEMORY_BYTES  # largest address space; None: not limited

    @classmethod
    def of(
        cls,
        argv: Sequence[str],
        *,
        directory: Path | None = None,
        environment: Mapping[str, str] | None = None,
        variables: Mapping[str, str] | None = None,
        stdin: Path = Path(os.devnull),
        memory_bytes: int | None = MEMORY_BYTES,
    ) -> Program:
        """Create a program from a command line, whose first word is looked up on the PATH.

        Args:
            environment: the program's environment; by default, this process's variables for paths,
                language, time zone and number of threads.
            variables: additional or changed variables.

        Raises:
            TargetError: the program does not exist or cannot be executed.
        """
        program = shutil.which(argv[0])
        if program is None:
            problem = "the program was not found or is not executable"
            raise TargetError(argv[0], problem).as_usage()
        chosen = _kept_environment() if environment is None else environment
        return cls(
            argv=(str(Path(program).resolve()), *argv[1:]),
            directory=(directory or Path.cwd()).resolve(),
            environment=tuple(sorted({**chosen, **(variables or {})}.items())),
            stdin=stdin,
            memory_bytes=memory_bytes,
        )


def _kept_environment() -> dict[str, str]:
    """Return this process's variables for paths, language, time zone and number of threads."""
    return {
        name: value
        for name, value in os.environ.items()
        if name in _KEPT or name.startswith(_KEPT_BEGINNINGS)
    }


def spawn(
    command: Program, *, stdout: Path, stderr: Path, mechanism: Mechanism | None = None
) -> Tracee:
    """Start a program without address randomisation, stopped before its first instruction.

    Raises:
        TracingForbidden: the operating system refuses to trace.
        TargetError: the program cannot be executed.
    """
    ours, theirs = socket.socketpair()
    with ours:
        with theirs:
            pid = _launch(command, stdout, stderr, theirs.fileno())
        tracee = Tracee(pid, pid, -pid, mechanism or Mechanism.best())
        with contextlib.ExitStack() as undo:
            undo.callback(os.waitpid, pid, 0)
            undo.callback(os.kill, pid, signal.SIGKILL)
            if not ours.recv(1):
                raise TargetError(command.argv[0], "the launching shell could not start")
            linux.seize(pid, kill_with_tracer=True)
            ours.send(b"\n")
            undo.pop_all()
    _await_exec(tracee, command)
    _fix_random_bytes(tracee)
    return tracee


def run_to_entry(tracee: Tracee) -> bool:
    """Run to the program's entry point, where its shared libraries are mapped already.

    Returns:
        False if the program ended first, for example because a library is missing.
    """
    entry = _auxiliary(tracee.pid, _AT_ENTRY)
    return entry is not None and tracee.run_to(entry)


def _launch(command: Program, stdout: Path, stderr: Path, channel: int) -> int:
    truncate = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    actions = [
        (os.POSIX_SPAWN_OPEN, 0, str(command.stdin), os.O_RDONLY, 0),
        (os.POSIX_SPAWN_OPEN, 1, str(stdout), truncate, 0o644),
        (os.POSIX_SPAWN_OPEN, 2, str(stderr), truncate, 0o644),
        (os.POSIX_SPAWN_DUP2, channel, 3),
    ]
    limit = "unlimited" if command.memory_bytes is None else str(command.memory_bytes >> 10)
    arguments = ["sh", "-c", _LAUNCHER, "sh", limit, str(command.directory), *command.argv]
    with linux.fixed_addresses():
        return os.posix_spawn(
            "/bin/sh",
            arguments,
            dict(command.environment),
            file_actions=actions,
            setsid=True,
            setsigmask=[],
            setsigdef=[signal.SIGPIPE, signal.SIGXFSZ, signal.SIGINT],
        )


def _await_exec(tracee: Tracee, command: Program) -> None:
    while True:
        status = linux.wait(tracee.pid)
        if status.ended:
            raise TargetError(command.argv[0], "cannot be executed")
        if status.event == linux.EVENT_EXEC:
            return
        number = status.signal if status.event == 0 else 0
        linux.request(linux.CONT, tracee.pid, 0, number)


def _fix_random_bytes(tracee: Tracee) -> None:
    """Replace the random bytes that the kernel passes to a new program with fixed bytes.

    libc derives its stack canary from them.
    """
    place = _auxiliary(tracee.pid, _AT_RANDOM)
    if place is not None:
        tracee.memory.write(place, bytes(range(1, 17)))


def _auxiliary(pid: int, key: int) -> int | None:
    """Return the value of `key` in a process's auxiliary vector, or None if it is missing.

    The keys are those of getauxval(3).
    """
    words = struct.iter_unpack("=QQ", Path(f"/proc/{pid}/auxv").read_bytes())
    return next((value for name, value in words if name == key), None)


# -- the system calls of one run

_STARTS = {
    linux.EVENT_CLONE: "starts a thread",
    linux.EVENT_FORK: "starts a child process",
    linux.EVENT_VFORK: "starts a child process",
    linux.EVENT_EXEC: "replaces itself by another program",
}
_DEVICES = ("/dev/", "/proc/", "pipe:", "socket:")
_HERE = -100  # AT_FDCWD
_NO_MEMORY = -12  # ENOMEM
_WRITING = 0o3 | 0o100 | 0o1000  # access mode, O_CREAT, O_TRUNC
_TERMINAL_IOCTLS = frozenset((0x5401, 0x5402, 0x5403, 0x5404, 0x5413))  # TCGETS ... TIOCGWINSZ
_IOCTL, _MAPS = 16, (9, 25)  # mmap, mremap
_NAMES = {56: "clone", 57: "fork", 58: "vfork", 59: "execve", 322: "execveat", 435: "clone3"}

# By call number: argument indices of folder descriptor, path and open flags (-1: none).
_PATHS = {
    2: (-1, 0, 1), 257: (0, 1, 2),  # open, openat
    437: (0, 1, -1), 85: (-1, 0, -1), 76: (-1, 0, -1),  # openat2, creat, truncate
    82: (-1, 1, -1), 264: (2, 3, -1), 316: (2, 3, -1),  # rename, renameat, renameat2
    87: (-1, 0, -1), 263: (0, 1, -1), 84: (-1, 0, -1),  # unlink, unlinkat, rmdir
    83: (-1, 0, -1), 258: (0, 1, -1), 133: (-1, 0, -1),  # mkdir, mkdirat, mknod
    86: (-1, 1, -1), 265: (2, 3, -1), 88: (-1, 1, -1), 266: (1, 2, -1),  # links
}  # fmt: skip


@dataclass(slots=True)
class ObservedRun:
    """The actions of a program in one run, as far as its system calls show them.

    Attributes:
        started: description of the first thread, child or program that it started; empty if none.
            After such a start, the rest of the run was not observed.
        written: absolute paths that it opened for writing, created, renamed or removed, in order.
        terminal: whether it tried to use a terminal.
        lacked_memory: whether the operating system refused it memory.
    """

    started: str = ""
    written: list[str] = field(default_factory=list)
    terminal: bool = False
    lacked_memory: bool = False


def watch(tracee: Tracee, *, wall_s: float) -> ObservedRun:
    """Run a stopped program to its end, for at most `wall_s` seconds, and watch its system calls.

    Watching stops early if the program starts a thread, a child process or another program.
    """
    observed, entering, number = ObservedRun(), True, 0
    with linux.ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=wall_s) as alarm:
        while True:
            tracee.registers.forget()
            linux.request(linux.SYSCALL, tracee.pid, 0, number)
            status = linux.wait(tracee.pid)
            if status.ended:
                tracee.handle(status, linux.CONT)
                break
            number = 0
            if status.event in _STARTS:
                call = _NAMES.get(tracee.registers.system_call or 0, "a system call")
                observed.started = f"{_STARTS[status.event]} (system call {call})"
                break
            if status.signal == linux.CALL_STOP:
                (_record_entry if entering else _record_exit)(tracee, observed)
                entering = not entering
            elif status.event == 0:
                number = status.signal
    if alarm.fired:
        tracee.kill()
    return observed


def _record_entry(tracee: Tracee, observed: ObservedRun) -> None:
    """At the entry of a system call, record any file to be changed and any use of a terminal."""
    registers = tracee.registers
    number = registers.system_call
    if number == _IOCTL:
        fd, request = (registers.read(name) for name in CALL_ARGUMENTS[:2])
        observed.terminal |= fd <= 2 and request & 0xFFFF_FFFF in _TERMINAL_IOCTLS
    if number not in _PATHS:
        return
    folder, path, flags = _PATHS[number]
    name = _text(tracee.memory, registers.read(CALL_ARGUMENTS[path]))
    observed.terminal |= name == "/dev/tty"
    if name and (flags < 0 or registers.read(CALL_ARGUMENTS[flags]) & _WRITING):
        base = _HERE if folder < 0 else _signed(registers.read(CALL_ARGUMENTS[folder]), 32)
        whole = _absolute(tracee.pid, base, name)
        if whole not in observed.written and not whole.startswith(_DEVICES):
            observed.written.append(whole)


def _record_exit(tracee: Tracee, observed: ObservedRun) -> None:
    """At the exit of a system call, record whether it was refused memory."""
    refused = _signed(tracee.registers.read("rax"), 64) == _NO_MEMORY
    observed.lacked_memory |= refused and tracee.registers.system_call in _MAPS


def _absolute(pid: int, folder: int, path: str) -> str:
    """Resolve a path against the process's working directory or the folder of a descriptor."""
    base = f"/proc/{pid}/cwd" if folder == _HERE else f"/proc/{pid}/fd/{folder}"
    try:
        return os.path.normpath(Path(os.readlink(base)) / path)
    except OSError:
        return os.path.normpath(path)


def _signed(value: int, bits: int) -> int:
    value &= (1 << bits) - 1
    return value - (value >> bits - 1 << bits)


def _text(memory: linux.Memory, address: int) -> str:
    """Return the NUL-terminated text at an address, or an empty string if it cannot be read."""
    try:
        data = memory.read(address, 4096 - address % 4096)
        if b"\0" not in data:
            data += memory.read(address + len(data), 4096)
    except (OSError, OverflowError):
        return ""
    return data.partition(b"\0")[0].decode(errors="replace")
