"""The companion's side of a node that is a program of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import time

from mavfi_cli.attack.kernels.scope import KernelScope
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.mission.companion.node_process import receive, send
from mavfi_cli.mission.instruction.server import Setup

_CHANNEL = 3
_FILE_CLOCK = 5  # CLOCK_REALTIME_COARSE, which stamps files; `time.time_ns` runs ahead of it
_KEPT = ("PATH", "HOME", "PYTHONPATH", "LD_LIBRARY_PATH", "NUMBA_CACHE_DIR")
_FIXED = {"PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


class SpawnedNode:
    """A started program; loads its kernels at once, so start it early.

    A program that compiles its modules has another memory than one that finds their bytecode. So
    one that has left something in a cache is ended, and another started, which finds it there.
    """

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        environment = {name: os.environ[name] for name in _KEPT if name in os.environ}
        actions = [
            (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
            (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
            (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0),
            (os.POSIX_SPAWN_DUP2, theirs.fileno(), _CHANNEL),
        ]
        # -P: where we stand must not decide what is imported, and so how its memory lies.
        line = [sys.executable, "-P", "-m", "mavfi_cli.mission.instruction.server", str(_CHANNEL)]
        self._started_ns = time.clock_gettime_ns(_FILE_CLOCK)
        with theirs, linux.fixed_addresses():
            self.pid = os.posix_spawn(
                sys.executable, line, {**environment, **_FIXED},
                file_actions=actions, setsid=True,
            )  # fmt: skip
        self.connection = ours

    def begin(self, setup: Setup) -> KernelScope:
        """Tell it which node it is, and wait until it is ready.

        Raises:
            TargetError: it could not start.
        """
        scope, cached_ns = self._ask(setup)
        if cached_ns >= self._started_ns:
            self.kill()
            self._start()
            scope, _ = self._ask(setup)
        return scope

    def _ask(self, setup: Setup) -> tuple[KernelScope, int]:
        try:
            send(self.connection, setup)
            answer: tuple[KernelScope, int] = receive(self.connection)
        except (OSError, EOFError):
            raise TargetError(f"node {setup.node}", "its process could not start") from None
        return answer

    def kill(self) -> None:
        """End it, if nobody else did."""
        self.connection.close()
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)
