"""A process in which nodes do their real work, beside the one that talks to the vehicle.

The process is a fork of the companion, so every kernel is loaded in it and every node's state is
its own copy. Inputs and outputs travel as pickles over a socket pair; numbers arrive to the bit,
so where a node runs changes nothing in the record of a mission.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from mavfi_cli.core.errors import NodeCrashed

Run = Callable[[Any, float], Any]
_LENGTH = 8


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
    host_s: float  # what the kernel took on this machine
    error: str | None = None


class NodeProcess:
    """Runs kernels for the executor: hand in orders, later take the answers.

    Args:
        runs: kernel by node name; the child uses its own copies.
    """

    def __init__(self, runs: Mapping[str, Run]) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._pid = os.fork()
        if self._pid == 0:
            ours.close()
            _serve(theirs, runs)
        theirs.close()
        self._socket = ours
        self._answers: dict[int, _Answer] = {}
        self._count = 0

    @property
    def pid(self) -> int:
        """Process id."""
        return self._pid

    def order(self, node: str, value: Any, start_s: float) -> int:
        """Have an input worked on; the number under which to ask for the output."""
        self._count += 1
        order = _Order(number=self._count, node=node, input=value, start_s=start_s)
        with self._crash_of(node):
            _send(self._socket, order)
        return order.number

    def take(self, node: str, number: int) -> tuple[Any, float]:
        """Wait for the output of an order; the output and the host seconds it took.

        Raises:
            NodeCrashed: the process ended, or the kernel raised an error.
        """
        with self._crash_of(node):
            while number not in self._answers:
                answer: _Answer = _receive(self._socket)
                self._answers[answer.number] = answer
        answer = self._answers.pop(number)
        if answer.error is not None:
            raise NodeCrashed(node, answer.error)
        return answer.output, answer.host_s

    @contextlib.contextmanager
    def _crash_of(self, node: str) -> Any:
        try:
            yield
        except (OSError, EOFError):
            raise NodeCrashed(node, self._end()) from None

    def _end(self) -> str:
        """How the process ended, in words."""
        with contextlib.suppress(ChildProcessError):
            _, status = os.waitpid(self._pid, 0)
            if os.WIFSIGNALED(status):
                return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
            return f"ended with code {os.waitstatus_to_exitcode(status)}"
        return "ended"

    def close(self) -> None:
        """End the process."""
        self._socket.close()
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self._pid, 0)


def _serve(connection: socket.socket, runs: Mapping[str, Run]) -> None:
    """The child's whole life: work on orders until the parent closes. Does not return."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the parent decides when it is over
    try:
        while True:
            order: _Order = _receive(connection)
            begun = perf_counter()
            output, error = None, None
            try:
                output = runs[order.node](order.input, order.start_s)
            except Exception as failure:  # the node's boundary: a crash is a result
                error = f"{type(failure).__name__}: {failure}\n{traceback.format_exc()}"
            host_s = perf_counter() - begun
            _send(
                connection,
                _Answer(number=order.number, output=output, host_s=host_s, error=error),
            )
    except (OSError, EOFError):
        os._exit(0)
    finally:
        os._exit(1)


def _send(connection: socket.socket, value: Any) -> None:
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    connection.sendall(len(data).to_bytes(_LENGTH, "little") + data)


def _receive(connection: socket.socket) -> Any:
    size = int.from_bytes(_exactly(connection, _LENGTH), "little")
    return pickle.loads(_exactly(connection, size))


def _exactly(connection: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        piece = connection.recv(size - len(data))
        if not piece:
            raise EOFError
        data += piece
    return bytes(data)
