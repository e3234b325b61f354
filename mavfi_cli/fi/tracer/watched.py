"""One run whose system calls are watched: what else a program does than compute.

A fault-free run is watched once. It tells whether the program starts threads or other programs,
which are not followed, what it writes where, and why it may have failed.
"""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.arch import asked, call_name, lacks_memory
from mavfi_cli.fi.tracer.linux import ProcessTimer
from mavfi_cli.fi.tracer.tracee import Tracee

_CALL_STOP = signal.SIGTRAP | 0x80  # PTRACE_O_TRACESYSGOOD
_STARTS = {
    linux.EVENT_CLONE: "starts a thread",
    linux.EVENT_FORK: "starts a child process",
    linux.EVENT_VFORK: "starts a child process",
    linux.EVENT_EXEC: "replaces itself by another program",
}
_DEVICES = ("/dev/", "/proc/", "pipe:", "socket:")


@dataclass(frozen=True, slots=True, kw_only=True)
class Watched:
    """What a program did in one run.

    Attributes:
        company: the first thread, child or other program that it started, in words; empty if none.
            The run was not watched any further.
        written: absolute paths that it wrote, made, renamed or removed, in order.
        terminal: whether it asked for a terminal.
        lacked_memory: whether it was refused memory.
    """

    company: str
    written: tuple[str, ...]
    terminal: bool
    lacked_memory: bool


def watch(tracee: Tracee, *, wall_s: float) -> Watched:
    """Run a stopped program to its end, at most `wall_s`, and watch its system calls."""
    written: dict[str, None] = {}
    terminal = lacked = False
    entering, company, number = True, "", 0
    with ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=wall_s) as alarm:
        while True:
            tracee.registers.forget()
            linux.request(linux.SYSCALL, tracee.pid, 0, number)
            status = linux.wait(tracee.pid)
            if status.ended:
                tracee.handle(status, linux.CONT)
                break
            number = 0
            if status.event in _STARTS:
                company = f"{_STARTS[status.event]} (system call {call_name(tracee.registers)})"
                break
            if status.signal == _CALL_STOP:
                if entering:
                    wants = asked(tracee.registers, tracee.memory)
                    terminal |= wants.terminal
                    if wants.writes and wants.path:
                        written.setdefault(_absolute(tracee.pid, wants.folder, wants.path))
                else:
                    lacked |= lacks_memory(tracee.registers)
                entering = not entering
            elif status.event == 0:
                number = status.signal
    if alarm.fired:
        tracee.kill()
    return Watched(
        company=company,
        written=tuple(path for path in written if not path.startswith(_DEVICES)),
        terminal=terminal,
        lacked_memory=lacked,
    )


def _absolute(pid: int, folder: int | None, path: str) -> str:
    """The path that a process names, relative to its folder or to that of a descriptor."""
    base = f"/proc/{pid}/cwd" if folder is None else f"/proc/{pid}/fd/{folder}"
    try:
        return os.path.normpath(Path(os.readlink(base)) / path)
    except OSError:
        return os.path.normpath(path)
