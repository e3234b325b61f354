"""Starts a Python program in the same state every time, so that its forks can be attacked.

Its memory depends only on its messages, so a corrupted pointer leads to the same data in every
repetition. It runs without address randomisation, in a fixed environment, and with all bytecode
cached. A fork of the attacking process would not do: it would inherit traces of everything that ran
there before.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import time
from typing import Any

from mavfi_cli.core.compiled import choose_caches
from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.processes import PYTHON, receive, send
from mavfi_cli.fi.tracer import linux

CHANNEL = 3  # file descriptor of the program's end of the socket
_FILE_CLOCK = 5  # CLOCK_REALTIME_COARSE, which stamps files; `time.time_ns` runs ahead of it
# The program gets no other environment variables, so that its memory does not depend on the
# shell's language, search path or virtual environment.
_KEPT = ("HOME", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "PYTHONPATH")
_FIXED = {
    "LANG": "C.UTF-8",
    "PATH": os.defpath,
    "PYTHONHASHSEED": "0",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
}
_early: dict[str, ServedProcess] = {}


class ServedProcess:
    """A Python program that runs in a process of its own and answers messages over a socket.

    Loading the program may take a long time, so start it early. A program that compiles its modules
    has a different memory layout from one that loads their bytecode. So a program that wrote to a
    cache is replaced by another, which loads from it.

    Attributes:
        pid: its process id.
        connection: our end of the socket to it.

    Args:
        module: the module to run. It receives one message and replies with a value and the result
            of `newest_cache_ns`.
        output: file descriptor of its standard output; None discards it.
    """

    def __init__(self, module: str, *, output: int | None = None) -> None:
        self._module, self._output = module, output
        self._errors = os.memfd_create("mavfi-errors")
        self._start()

    @classmethod
    def start_early(cls, module: str) -> None:
        """Start the program `module` now, because loading is slow. The next `of` returns it."""
        if module not in _early:
            _early[module] = cls(module)

    @classmethod
    def of(cls, module: str) -> ServedProcess:
        """Return the program `module` that was started early, or else start it now."""
        return _early.pop(module, None) or cls(module)

    def _start(self) -> None:
        self.connection, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        choose_caches()  # before the first program, which would otherwise choose its own
        environment = {name: os.environ[name] for name in _KEPT if name in os.environ}
        output = (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)
        actions = [
            (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
            output if self._output is None else (os.POSIX_SPAWN_DUP2, self._output, 1),
            (os.POSIX_SPAWN_DUP2, self._errors, 2),
            (os.POSIX_SPAWN_DUP2, theirs.fileno(), CHANNEL),
        ]
        line = [*PYTHON, "-m", self._module]  # the imports determine the memory layout
        self._started_ns = time.clock_gettime_ns(_FILE_CLOCK)
        with theirs, linux.fixed_addresses():
            self.pid = os.posix_spawn(
                sys.executable, line, {**environment, **_FIXED},
                file_actions=actions, setsid=True,
            )  # fmt: skip
        self._ended = False

    def begin(self, message: Any, name: str) -> Any:
        """Send the first message, wait until the program is ready, and return its answer.

        Raises:
            TargetError: the program did not start.
        """
        answer, cached_ns = self._ask(message, name)
        if cached_ns >= self._started_ns:
            self._end()
            self._start()
            answer, _ = self._ask(message, name)
        return answer

    def _ask(self, message: Any, name: str) -> tuple[Any, int]:
        try:
            send(self.connection, message)
            answer: tuple[Any, int] = receive(self.connection)
        except (OSError, EOFError):
            raise TargetError(name, f"does not start: {self.last_error()}") from None
        return answer

    def last_error(self) -> str:
        """Return the last line that the program wrote to standard error, or else a default text."""
        lines = os.pread(self._errors, 1 << 20, 0).decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "its process ended"

    def _end(self) -> None:
        if self._ended:  # its id may be that of another process by now
            return
        self._ended = True
        self.connection.close()
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)

    def kill(self) -> None:
        """Kill the program if it has not ended."""
        self._end()
        if self._errors >= 0:
            os.close(self._errors)
            self._errors = -1


def newest_cache_ns() -> int:
    """Return the time of the newest change in the caches of the loaded modules.

    The caches hold bytecode and compiled kernels. The time is in ns since the epoch, or 0 if there
    are no caches.
    """
    specs = [getattr(module, "__spec__", None) for module in sys.modules.values()]
    files = [spec.cached for spec in specs if spec is not None and spec.cached is not None]
    folders = sorted({os.path.dirname(file) for file in files})
    return max(
        (os.stat(folder).st_mtime_ns for folder in folders if os.path.isdir(folder)), default=0
    )
