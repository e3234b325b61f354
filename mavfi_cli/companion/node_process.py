"""A process that runs the kernels of nodes outside the mission's process.

The process is a fork of the companion, so it has every kernel loaded and its own copy of every
node's state. Inputs and outputs are sent as pickles over a socket pair. Numbers stay exact, so
running a node in its own process does not change the record of a mission.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import resource
import select
import signal
import socket
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NoReturn

from mavfi_cli.core.errors import described
from mavfi_cli.core.processes import fork, receive, send

Run = Callable[[Any, float], Any]

# A node hangs if one invocation exceeds this CPU time or this wall-clock time; the latter catches a
# node that only waits. A healthy invocation takes well under half a second. The record depends only
# on whether a limit was exceeded, not on its value.
HANG_CPU_S = 5.0
HANG_WALL_S = 120.0
HUNG = "hung: killed by the watchdog"
_LOOK_S = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class _Order:
    number: int
    node: str
    input: Any
    start_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Answer:
    number: int
    output: Any
    host_s: float  # host time of the kernel
    error: str | None = None


class NodeLost(Exception):
    """A node's process ended or hung, or its kernel failed. The executor sets node and stamp."""

    node = ""
    stamp_s = 0.0  # due time of the output, or time of the watchdog's kill

    def __init__(self, *, hung: bool, how: str, traceback: str = "") -> None:
        super().__init__(how)
        self.hung, self.how = hung, how
        self.traceback = traceback  # traceback of an error in the kernel


class NodeProcess:
    """A process that runs kernels for the executor.

    `order` sends an input to a kernel, and `take` returns the output.

    Args:
        ending: If other code reaps the process, returns a description of how it ended; otherwise
            returns None.
        answered: Called after each answer or loss, before the process gets another input; may be
            set later.
        patient: Never treat the process as hung, because a debugger may hold it.
    """

    def __init__(
        self,
        connection: socket.socket,
        pid: int,
        *,
        ending: Callable[[], str | None] = lambda: None,
        answered: Callable[[], None] = lambda: None,
        patient: bool = False,
    ) -> None:
        self._socket = connection
        self.pid = pid
        self._ending = ending
        self.answered = answered
        self._patient = patient
        if not patient:
            connection.settimeout(HANG_WALL_S)  # a corrupted node may stop in mid-message
        self._answers: dict[int, _Answer] = {}
        self._count = 0
        self._gone = False  # True once it was reaped, because its id may then be reused

    @classmethod
    def fork(cls, runs: Mapping[str, Run]) -> NodeProcess:
        """Fork this process. The fork runs the given kernels, which are keyed by node name."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)

        def child() -> int:
            ours.close()
            cls.serve(theirs, runs)

        pid = fork(child)
        theirs.close()
        return cls(ours, pid)

    def order(self, node: str, value: Any, start_s: float) -> int:
        """Send an input to a node. Return the number to pass to `take`.

        If the process has already ended, `take` reports it.
        """
        self._count += 1
        order = _Order(number=self._count, node=node, input=value, start_s=start_s)
        with contextlib.suppress(OSError):
            send(self._socket, order)
        return order.number

    @property
    def next_number(self) -> int:
        """The number that the next request will get."""
        return self._count + 1

    def rehearse(self, node: str, value: Any, start_s: float) -> None:
        """Send the next request to a fork that shares the connection, without counting it."""
        self.order(node, value, start_s)
        self._count -= 1

    def take(self, number: int) -> tuple[Any, float]:
        """Wait for the output of a request. Return it with the kernel's host time in seconds.

        Raises:
            NodeLost: The process ended or hung, or its kernel raised an error.
        """
        try:
            answer = self._await(number)
        finally:
            self.answered()
        if answer.error is not None:
            how, _, trace = answer.error.partition("\n")
            raise NodeLost(hung=False, how=how, traceback=trace)
        return answer.output, answer.host_s

    def _await(self, number: int) -> _Answer:
        begun_s, used_s = time.monotonic(), self._cpu_s()
        try:
            while number not in self._answers:
                while not select.select([self._socket], [], [], _LOOK_S)[0]:
                    used = self._cpu_s() - used_s > HANG_CPU_S
                    if (used or time.monotonic() - begun_s > HANG_WALL_S) and not self._patient:
                        raise NodeLost(hung=True, how=HUNG)
                answer: _Answer = receive(self._socket)
                self._answers[answer.number] = answer
        except TimeoutError:
            raise NodeLost(hung=True, how=HUNG) from None
        except (OSError, EOFError):
            raise NodeLost(hung=False, how=self._end()) from None
        except NodeLost:
            raise
        except Exception:  # a corrupted pickle can raise any error
            raise NodeLost(hung=False, how="garbled its output") from None
        return self._answers.pop(number)

    def _cpu_s(self) -> float:
        """Return the CPU time that the process has used, in seconds, or 0 if it has ended."""
        try:
            return time.clock_gettime(~self.pid << 3 | 2)  # clock id of clock_getcpuclockid
        except OSError:
            return 0.0

    def _end(self) -> str:
        """Reap the process if necessary, and describe how it ended."""
        ending = self._ending()
        self._gone = True
        if ending is not None:
            return ending
        with contextlib.suppress(ChildProcessError):
            return _described_end(os.waitpid(self.pid, 0)[1])
        return "ended"

    def close(self, *, kill: bool = False) -> None:
        """Close the connection, so that the process exits, and reap it.

        Args:
            kill: Send the process SIGKILL, too, in case it is stuck.
        """
        self._socket.close()
        if self._gone:
            return
        self._gone = True
        if kill:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
        if self._ending() is None:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self.pid, 0)

    @staticmethod
    def serve(connection: socket.socket, runs: Mapping[str, Run]) -> NoReturn:
        """Serve requests in the child until the parent closes the connection. Does not return."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # only the parent ends this process
        faulthandler.disable()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            while True:
                order: _Order = receive(connection)
                begun = perf_counter()
                output, error = None, None
                try:
                    output = runs[order.node](order.input, order.start_s)
                except Exception as failure:  # the node's boundary: a crash is a result
                    error = f"{described(failure)}\n{traceback.format_exc()}"
                host_s = perf_counter() - begun
                send(
                    connection,
                    _Answer(number=order.number, output=output, host_s=host_s, error=error),
                )
        except (OSError, EOFError):
            os._exit(0)
        finally:
            os._exit(1)


class StruckNodeProcess(NodeProcess):
    """A process that a fault struck outside the flight, and that is already working on a request.

    It is the child of another process, which reaps it later.

    Args:
        number: the number of the request that it is working on.
    """

    def __init__(self, connection: socket.socket, pid: int, *, number: int) -> None:
        super().__init__(connection, pid, ending=self._end_of_zombie)
        self._count, self._has_order = number, True

    def order(self, node: str, value: Any, start_s: float) -> int:
        """Send an input as `NodeProcess` does, but not the first, which the process already has."""
        if self._has_order:
            self._has_order = False
            return self._count
        return super().order(node, value, start_s)

    def _end_of_zombie(self) -> str | None:
        """Wait until the process ends, and describe how. Return None if it was already reaped."""
        with contextlib.suppress(OSError):
            while True:
                stat = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
                if stat[0] == "Z":
                    return _described_end(int(stat[49]))  # field 52, proc_pid_stat(5)
                time.sleep(_LOOK_S / 100)
        return None


class LostNode(NodeProcess):
    """A stand-in for a process that ends or hangs during its next request."""

    def __init__(self, loss: NodeLost) -> None:
        self._loss = loss
        self.answered = lambda: None

    def order(self, node: str, value: Any, start_s: float) -> int:
        """Send nothing, and return 0 as the number of the request."""
        return 0

    def take(self, number: int) -> tuple[Any, float]:
        """Raise the loss."""
        self.answered()
        raise self._loss

    def close(self, *, kill: bool = False) -> None:
        """Do nothing, because no process is left."""


def _described_end(status: int) -> str:
    """Describe how a process ended, given its wait status."""
    if os.WIFSIGNALED(status):
        return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    return f"ended with code {os.waitstatus_to_exitcode(status)}"
