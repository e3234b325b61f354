"""Processes: how one is bound to its parent, found, ended, and sent values."""

from __future__ import annotations

import contextlib
import ctypes
import os
import pickle
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36
# What ps calls them.
SERVER, GUARD, WORKER = "mavfi-server", "mavfi-guard", "mavfi-worker"
ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
}
"""Environment of a process that forks itself. Its libraries then start no threads."""

_prctl = ctypes.CDLL(None, use_errno=True).prctl

_LENGTH = 8


def fork(work: Callable[[], int]) -> int:
    """Do work in a fork of this process, which exits with the returned code, or 1 on an error.

    Returns:
        Process id of the fork.
    """
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        code = work()
    finally:
        os._exit(code)


def become_reaper() -> None:
    """Make orphaned descendants of this process its children from now on."""
    _request(_PR_SET_CHILD_SUBREAPER, 1)


def die_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends. Exit now if it has already ended."""
    _request(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


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


def end_children() -> None:
    """Kill and reap every descendant of this process, which is their reaper.

    A killed child leaves its own children to us, so the loop ends when there are none.
    """
    while children := _children():
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


def send(connection: socket.socket, value: Any) -> None:
    """Send one value."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    connection.sendall(len(data).to_bytes(_LENGTH, "little") + data)


def receive(connection: socket.socket) -> Any:
    """Receive one value.

    Raises:
        EOFError: The other end has closed.
    """
    size = int.from_bytes(_exactly(connection, _LENGTH), "little")
    return pickle.loads(_exactly(connection, size))


def _exactly(connection: socket.socket, size: int) -> bytearray:
    """Receive into a single buffer, so that a node's memory is the same in every run."""
    data = bytearray(size)
    view, filled = memoryview(data), 0
    while filled < size:
        count = connection.recv_into(view[filled:])
        if not count:
            raise EOFError
        filled += count
    view.release()
    return data


@contextlib.contextmanager
def interruptible() -> Iterator[list[int]]:
    """Turn Ctrl-C and SIGTERM into a request, so that a mission ends with a complete record.

    Yields a list that is empty until a signal arrives. Has no effect outside the main thread.
    """
    asked: list[int] = []
    previous: dict[signal.Signals, Any] = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # not the main thread
            previous[number] = signal.signal(number, lambda n, _frame: asked.append(n))
    try:
        yield asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
