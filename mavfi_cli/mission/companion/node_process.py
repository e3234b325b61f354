"""A process in which nodes do their real work, beside the one that talks to the vehicle.

The process is a fork of the companion, so every kernel is loaded in it and every node's state is
its own copy. Inputs and outputs travel as pickles over a socket pair; numbers arrive to the bit,
so where a node runs changes nothing in the record of a mission.
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
from time import perf_counter
from typing import Any

from mavfi_cli.core.channel import receive, send

Run = Callable[[Any, float], Any]

# A node hangs when one invocation takes this much of the processor, or of the wall clock where it
# waits for something. The slowest healthy one takes well under half a second; what the limits are
# does not enter the record, only whether they were passed.
HANG_CPU_S = 5.0
HANG_WALL_S = 120.0
_LOOK_S = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class _Order:
    number: int
    node: str
    input: Any
    start_s: float


@dataclass(frozen=True, slots=True)
class _Rehearse:
    """Instead of an order: have a fork work on the order that comes next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Answer:
    number: int
    output: Any
    host_s: float  # what the kernel took on this machine
    error: str | None = None


class NodeLost(Exception):
    """A node's process is gone, or had to be killed: what the executor makes the best of."""

    def __init__(self, *, hung: bool, how: str, traceback: str = "") -> None:
        super().__init__(how)
        self.hung = hung
        self.how = how
        self.traceback = traceback  # of an error in the kernel


class NodeProcess:
    """Runs kernels for the executor: hand in orders, later take the answers.

    Args:
        connection: our end of the socket pair.
        pid: of the process, a child of ours.
        ending: tells how the process ended where somebody else heard of it first, else None.
        patient: a debugger may hold it, so it never hangs.
    """

    def __init__(
        self,
        connection: socket.socket,
        pid: int,
        *,
        ending: Callable[[], str | None] = lambda: None,
        patient: bool = False,
    ) -> None:
        self._socket = connection
        self._pid = pid
        self._ending = ending
        self._patient = patient
        if not patient:
            connection.settimeout(HANG_WALL_S)  # a corrupted node may stop in the middle of a word
        self._answers: dict[int, _Answer] = {}
        self._count = 0
        self._gone = False  # and reaped: its number may belong to another process by now

    @classmethod
    def fork(cls, runs: Mapping[str, Run]) -> NodeProcess:
        """A fork of this process.

        Args:
            runs: kernel by node name; the child uses its own copies.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        pid = os.fork()
        if pid == 0:
            ours.close()
            serve(theirs, runs)
        theirs.close()
        return cls(ours, pid)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._pid

    def order(self, node: str, value: Any, start_s: float) -> int:
        """Have an input worked on; the number under which to ask for the output.

        A process that is gone already is noticed when the output is asked for.
        """
        self._count += 1
        order = _Order(number=self._count, node=node, input=value, start_s=start_s)
        with contextlib.suppress(OSError):
            send(self._socket, order)
        return order.number

    def rehearse(self) -> int:
        """Fork the process; the fork works on the next order, ends, and never answers.

        The process goes on, as if nothing had been, once the fork has ended.

        Returns:
            Process id of the fork, which waits for its order.

        Raises:
            OSError, EOFError: the process is gone.
        """
        send(self._socket, _Rehearse())
        fork: int = receive(self._socket)
        return fork

    def take(self, number: int) -> tuple[Any, float]:
        """Wait for the output of an order; the output and the host seconds it took.

        Raises:
            NodeLost: the process ended, hung and was killed, or its kernel raised an error.
        """
        begun_s, used_s = time.monotonic(), self._cpu_s()
        try:
            while number not in self._answers:
                while not select.select([self._socket], [], [], _LOOK_S)[0]:
                    used = self._cpu_s() - used_s > HANG_CPU_S
                    if (used or time.monotonic() - begun_s > HANG_WALL_S) and not self._patient:
                        raise NodeLost(hung=True, how="hung: killed by the watchdog")
                answer: _Answer = receive(self._socket)
                self._answers[answer.number] = answer
        except TimeoutError:
            raise NodeLost(hung=True, how="hung: killed by the watchdog") from None
        except (OSError, EOFError):
            raise NodeLost(hung=False, how=self._end()) from None
        except NodeLost:
            raise
        except Exception:  # whatever a corrupted node's words make of the one who reads them
            raise NodeLost(hung=False, how="garbled its output") from None
        answer = self._answers.pop(number)
        if answer.error is not None:
            how, _, told = answer.error.partition("\n")
            raise NodeLost(hung=False, how=how, traceback=told)
        return answer.output, answer.host_s

    def _cpu_s(self) -> float:
        """Processor seconds that the process has used; 0 once it is gone."""
        try:
            return time.clock_gettime(
                ~self._pid << 3 | 2
            )  # the clock that clock_getcpuclockid names
        except OSError:
            return 0.0

    def _end(self) -> str:
        """How the process ended, in words."""
        told = self._ending()
        self._gone = True
        if told is not None:
            return told
        with contextlib.suppress(ChildProcessError):
            _, status = os.waitpid(self._pid, 0)
            if os.WIFSIGNALED(status):
                return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
            return f"ended with code {os.waitstatus_to_exitcode(status)}"
        return "ended"

    def close(self, *, kill: bool = False) -> None:
        """End the process: it ends itself when the connection closes, unless it cannot hear."""
        self._socket.close()
        if self._gone:
            return
        self._gone = True
        if kill:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)
        if self._ending() is None:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self._pid, 0)


def serve(connection: socket.socket, runs: Mapping[str, Run]) -> None:
    """The child's whole life: work on orders until the parent closes. Does not return."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the parent decides when it is over
    faulthandler.disable()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        while True:
            order: _Order | _Rehearse = receive(connection)
            if isinstance(order, _Rehearse):
                _rehearse(connection, runs)
                continue
            begun = perf_counter()
            output, error = None, None
            try:
                output = runs[order.node](order.input, order.start_s)
            except Exception as failure:  # the node's boundary: a crash is a result
                error = f"{type(failure).__name__}: {failure}\n{traceback.format_exc()}"
            host_s = perf_counter() - begun
            send(
                connection,
                _Answer(number=order.number, output=output, host_s=host_s, error=error),
            )
    except (OSError, EOFError):
        os._exit(0)
    finally:
        os._exit(1)


def _rehearse(connection: socket.socket, runs: Mapping[str, Run]) -> None:
    pid = os.fork()
    if pid:
        send(connection, pid)
        os.waitpid(pid, 0)
        return
    order: _Order = receive(connection)
    runs[order.node](order.input, order.start_s)
    os._exit(0)
