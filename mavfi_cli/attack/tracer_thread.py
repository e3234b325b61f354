"""Traces a node that keeps running, in a thread separate from the code that uses the node.

ptrace obeys only the thread that attached.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Generic, TypeVar

from mavfi_cli.fi.tracer.tracee import ExecutionCounter, Mechanism, Tracee

Notice = Callable[[], None]
T = TypeVar("T")


class TracerThread(Generic[T]):
    """A separate thread that works on a traced node.

    Args:
        work: the work of the thread. It receives a function that it must call once the node runs
            towards the awaited event.
    """

    def __init__(self, work: Callable[[Notice], T]) -> None:
        self._armed, self._done = threading.Event(), Future[T]()

        def run() -> None:
            try:
                self._done.set_result(work(self._armed.set))
            except BaseException as error:  # the thread's boundary: `result` raises it again
                self._done.set_exception(error)
            finally:
                self._armed.set()

        threading.Thread(target=run, daemon=True).start()

    def await_armed(self) -> None:
        """Wait until the fault is armed in the running node, or raise the tracer thread's error."""
        self._armed.wait()
        if self._done.done():
            self._done.result()

    @property
    def done(self) -> bool:
        """True once the work has ended, even with an error."""
        return self._done.done()

    def result(self) -> T:
        """Wait until the work has ended, then return its result or raise its error."""
        return self._done.result()


class EntryCounter:
    """Counts the executions of one instruction in a node that keeps running.

    If the operating system cannot count, a tracer stops the node at each execution. The count is
    exact whenever the node has answered, because it answers after its last stop.

    Args:
        pid: the node; closing the counter may end it.
    """

    def __init__(self, pid: int, address: int) -> None:
        self._pid, self._address, self._stops = pid, address, 0
        self._counter: ExecutionCounter | None = None
        self._tracer: TracerThread[None] | None = None
        if Mechanism.best() is Mechanism.PERF:
            self._counter = ExecutionCounter(pid, address)
        else:
            self._tracer = TracerThread(self._count)
            self._tracer.await_armed()

    def read(self) -> int:
        """Return the number of executions since the counter was created."""
        return self._stops if self._counter is None else self._counter.read()

    def close(self) -> None:
        """Remove the counter. If counting required tracing the node, end the node too."""
        if self._counter is not None:
            self._counter.close()
        if self._tracer is not None:
            with suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)
            self._tracer.result()

    def _count(self, armed: Notice) -> None:
        tracee = Tracee.attach(self._pid)
        tracee.breakpoint_at(self._address)
        armed()
        while tracee.resume() is None:
            self._stops += tracee.registers.ip == self._address
