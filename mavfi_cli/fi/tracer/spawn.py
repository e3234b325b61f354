"""Starts a program under the tracer, stopped at its first instruction or its entry point."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.tracee import Mechanism, Tracee, best_mechanism

# The shell says that it runs (so that its own exec is over) and waits for one line (so that the
# tracer is attached before the program starts).
# No core files, no endless output (in blocks of 512 bytes) and no endless memory (KiB) of a
# corrupted program, and nothing in its environment that depends on where it runs.
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
        stdin: Path = Path(os.devnull),
        memory_bytes: int | None = MEMORY_BYTES,
    ) -> Program:
        """Make a command whose program is looked up on the path.

        Args:
            environment: by default those of our own variables that say where things are, in which
                language to speak, and how many threads to start.

        Raises:
            TargetError: no such program, or it cannot be executed.
        """
        found = shutil.which(argv[0])
        if found is None:
            raise TargetError(argv[0], "no such program, or it is not executable")
        chosen = kept_environment() if environment is None else environment
        return cls(
            argv=(str(Path(found).resolve()), *argv[1:]),
            directory=(directory or Path.cwd()).resolve(),
            environment=tuple(sorted(chosen.items())),
            stdin=stdin,
            memory_bytes=memory_bytes,
        )


def kept_environment() -> dict[str, str]:
    """Our own environment without what changes from shell to shell: it lies in memory."""
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
        tracee = Tracee(pid, pid, -pid, mechanism or best_mechanism())
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
    """Run to the program's entry point, where its shared libraries are mapped.

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
    """Replace the random bytes that the kernel hands to a program that has not begun.

    libc makes its stack canary of them.
    """
    place = _auxiliary(tracee.pid, _AT_RANDOM)
    if place is not None:
        tracee.memory.write(place, bytes(range(1, 17)))


def _auxiliary(pid: int, key: int) -> int | None:
    """A value of the auxiliary vector of a program (getauxval(3))."""
    words = struct.iter_unpack("=QQ", Path(f"/proc/{pid}/auxv").read_bytes())
    return next((value for name, value in words if name == key), None)
