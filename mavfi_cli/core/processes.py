"""Processes of one mission: how they are bound to their keeper, found, and ended."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from pathlib import Path

_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36
# Process names in ps and top.
TEMPLATE, SLOT, MISSION = "mavfi-template", "mavfi-slot", "mavfi-mission"
VEHICLES, VEHICLE = "mavfi-vehicles", "mavfi-vehicle"  # the template of vehicles, and one
ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
}
"""Environment of a process that forks itself. Its libraries then start no threads."""

_prctl = ctypes.CDLL(None, use_errno=True).prctl


def become_reaper() -> None:
    """Make orphaned descendants of this process its children from now on."""
    _request(_PR_SET_CHILD_SUBREAPER, 1)


def die_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends. Exit now if it has already ended."""
    _request(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def fork_beside(reaper: int) -> int | None:
    """Fork, with a reaper as the parent instead of this process.

    Args:
        reaper: process id of the nearest reaper among the ancestors of this process. The child dies
            with it.

    Returns:
        0 in the child, its process id here; None where something killed it before it could say so.
    """
    reading, writing = os.pipe()
    between = os.fork()
    if between:
        os.close(writing)
        with open(reading, "rb", buffering=0) as pipe:
            told = pipe.read()
        os.waitpid(between, 0)
        return int(told) if told else None
    middle = os.getpid()
    if os.fork():
        os._exit(0)
    os.close(reading)
    os.write(writing, str(os.getpid()).encode())
    os.close(writing)
    while os.getppid() == middle:  # it is about to end
        os.sched_yield()
    die_with(reaper)
    return 0


def threads() -> int:
    """Count the threads of this process. A fork copies one thread, but the locks of all."""
    return len(os.listdir("/proc/self/task"))


def call_this_process(name: str) -> None:
    """Set the name of this process in ps and top, at most 15 bytes."""
    _request(_PR_SET_NAME, ctypes.c_char_p(name.encode()))


def _request(option: int, value: int | ctypes.c_char_p) -> None:
    if _prctl(option, value, 0, 0, 0) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def end_children(spare: int | None = None) -> None:
    """Kill and reap every descendant of this process, which must be their reaper.

    A killed child leaves its own children to us, so the loop ends when there are none.

    Args:
        spare: a child that is left alone, with all that it started.
    """
    while children := [pid for pid in _children() if pid != spare]:
        for pid in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for pid in children:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, 0)


def _children() -> list[int]:
    found: list[int] = []
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            found += map(int, (task / "children").read_text().split())
    return found
