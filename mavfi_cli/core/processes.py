"""Forks processes, sends values between them, detects their end, and handles interrupts."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import fcntl
import importlib
import io
import operator
import os
import pickle
import re
import select
import signal
import socket
import struct
import sys
from collections.abc import Callable, Iterator
from enum import EnumMeta
from pathlib import Path
from typing import Any

PYTHON = (sys.executable, "-P")
"""Command line of this Python interpreter. `-P` prevents imports from the working directory."""

_LENGTH = 8
_COLOUR = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")  # a terminal's colour code
_NEW_USER, _NEW_NETWORK = 0x1000_0000, 0x4000_0000  # unshare(2)
_SET_FLAGS, _UP = 0x8914, 0x1  # netdevice(7)
# PIDFD_GET_INFO of linux/pidfd.h: the number, the mask and the last field of `struct pidfd_info`,
# and the bit of the mask for the status.
_GET_INFO, _PIDFD_INFO, _INFO_EXIT = 0xC040_FF0B, struct.Struct("<Q52xi"), 1 << 3
_libc = ctypes.CDLL(None)


def fork(work: Callable[[], int] | None, *, exact: bool = False) -> int:
    """Fork this process, and run `work` in the fork. Return the process id of the fork.

    The fork exits with the code that `work` returns, or with 1 if `work` raises an exception.

    Args:
        work: What the fork runs. With None, this call returns in the fork, too, with 0.
        exact: Skip Python's hooks, which draw new random numbers, so that every fork has the same
            memory. The process must have one thread.
    """
    child = int(_libc.fork()) if exact else os.fork()
    if child or work is None:
        return child
    code = 1
    try:
        code = work()
    finally:
        os._exit(code)


def send(connection: socket.socket, value: Any) -> None:
    """Pickle a value and send it to the process at the other end, which calls `receive`."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    connection.sendall(len(data).to_bytes(_LENGTH, "little") + data)


def value_of(message: bytes) -> Any:
    """Decode one message, given as the bytes that `send` writes, and return its value.

    Raises:
        pickle.UnpicklingError: The value has a type that messages do not contain.
    """
    return _Values(io.BytesIO(message[_LENGTH:])).load()


def receive(connection: socket.socket) -> Any:
    """Receive one value that the process at the other end sent with `send`.

    Decoding is safe: bytes from a corrupted process cannot call any function.

    Raises:
        EOFError: The other end has closed the connection.
        pickle.UnpicklingError: The value has a type that messages do not contain.
    """
    size = int.from_bytes(_exactly(connection, _LENGTH), "little")
    return _Values(io.BytesIO(_exactly(connection, size))).load()


_BUILT_IN = {
    "builtins": ("range", "complex", "set", "frozenset"),
    "numpy": ("ndarray", "dtype"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "pathlib": ("Path", "PosixPath"),
}


class _Values(pickle.Unpickler):
    """An unpickler that accepts only plain values, numpy's values and mavfi's own messages.

    Messages consist of mavfi's dataclasses and enumerations.
    """

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy._core.numeric", "_frombuffer"):
            return _array
        if module in sys.modules and name in _BUILT_IN.get(module, ()):
            return getattr(sys.modules[module], name)
        if module.startswith(("mavfi_cli.", "sitl.")):
            kind = operator.attrgetter(name)(importlib.import_module(module))
            if dataclasses.is_dataclass(kind) or (type(kind) is EnumMeta):
                return kind
        raise pickle.UnpicklingError(f"{module}.{name} is not a message type")


def _array(buffer: Any, dtype: Any, shape: Any, order: Any, *axes: Any) -> Any:
    """Create an unpickled array, with numpy's own object as its dtype.

    A pickle encodes which objects are identical. With numpy's own dtype object, an array that has
    been received is pickled to the same bytes as one that was created here.
    """
    make = sys.modules["numpy._core.numeric"]._frombuffer
    return make(buffer, sys.modules["numpy"].dtype(dtype.str), shape, order, *axes)


def _exactly(connection: socket.socket, size: int) -> bytearray:
    """Receive exactly `size` bytes into one buffer.

    One call does so, which makes the memory of a node the same in every run. Only a signal, or a
    socket with a timeout, which no attacked node has, causes further calls.

    Raises:
        EOFError: The other end has closed the connection.
    """
    data = bytearray(size)
    view, filled = memoryview(data), 0
    while filled < size:
        count = connection.recv_into(view[filled:], flags=socket.MSG_WAITALL)
        if not count:
            raise EOFError
        filled += count
    view.release()
    return data


@contextlib.contextmanager
def interruptible() -> Iterator[list[int]]:
    """Collect Ctrl-C and SIGTERM in a list instead of ending, as a context manager.

    The list is empty until a signal arrives. A mission checks it, so that it can end with a
    complete record. Outside the main thread, signals are not collected.
    """
    received: list[int] = []
    previous: dict[signal.Signals, Any] = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # not the main thread
            previous[number] = signal.signal(number, lambda n, _frame: received.append(n))
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def leave_network() -> bool:
    """Move this process to a network namespace of its own, which has only a loopback interface.

    Future children of the process share the namespace, so they can use ports that are taken
    elsewhere. The process must have one thread.

    Returns:
        True on success, False if the operating system does not allow it.

    Raises:
        OSError: The loopback interface cannot be used.
    """
    user, group = os.getuid(), os.getgid()
    if _libc.unshare(_NEW_NETWORK) != 0:
        if _libc.unshare(_NEW_NETWORK | _NEW_USER) != 0:
            return False
        own = Path("/proc/self")
        (own / "setgroups").write_text("deny")  # user_namespaces(7) requires it
        (own / "uid_map").write_text(f"{user} {user} 1")
        (own / "gid_map").write_text(f"{group} {group} 1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, _SET_FLAGS, struct.pack("16sh22x", b"lo", _UP))
    return True


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """How a process ended. At most one field is set, and none if the status is unknown."""

    exit_code: int | None
    signal: int | None

    @classmethod
    def of(cls, code: int) -> Ended:
        """Convert an exit code as `subprocess` gives it, where a negative code is a signal."""
        return cls(exit_code=None, signal=-code) if code < 0 else cls(exit_code=code, signal=None)

    @staticmethod
    def last_lines(output: bytes, most: int) -> list[str]:
        """Return the last lines of a process's output, without colours and control characters.

        Blank lines are left out.

        Args:
            most: Largest number of lines.
        """
        text = _COLOUR.sub("", output.decode(errors="replace"))
        lines = ("".join(filter(str.isprintable, line)).strip() for line in text.split("\n"))
        return [line for line in lines if line][-most:]

    def describe(self) -> str:
        """Describe in words, for a record, how the process ended."""
        if self.signal is not None:
            known = self.signal in signal.Signals.__members__.values()
            return f"killed by {signal.Signals(self.signal).name if known else self.signal}"
        return "ended" if self.exit_code is None else f"ended with code {self.exit_code}"


class EndWatch:
    """Detects the end of a process, which need not be a child (pidfd_open(2)).

    Raises:
        ProcessLookupError: The process does not exist.
    """

    def __init__(self, pid: int) -> None:
        self._pid, self._descriptor = pid, os.pidfd_open(pid)
        self._poller = select.poll()
        self._poller.register(self._descriptor, select.POLLIN)

    def look(self) -> Ended | None:
        """Return how the process ended, or None if it still runs.

        Before Linux 6.15, the exit status is unknown if the process has already been reaped.
        """
        if not self._poller.poll(0):
            return None
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            stat = Path(f"/proc/{self._pid}/stat").read_text()
            state, *_, status = stat.rpartition(")")[2].split()  # field 52, proc_pid_stat(5)
            if state == "Z":  # else another process has reused its id
                return Ended.of(os.waitstatus_to_exitcode(int(status)))
        return self._reaped()

    def _reaped(self) -> Ended:
        """Return how the process ended that has been reaped, if the kernel still knows it."""
        info = bytearray(_PIDFD_INFO.pack(_INFO_EXIT, 0))
        with contextlib.suppress(OSError):
            fcntl.ioctl(self._descriptor, _GET_INFO, info)
            known, status = _PIDFD_INFO.unpack(info)
            if known & _INFO_EXIT:
                return Ended.of(os.waitstatus_to_exitcode(status))
        return Ended(exit_code=None, signal=None)

    def close(self) -> None:
        """Stop watching the process."""
        os.close(self._descriptor)
