"""A thread that traces: ptrace obeys only the thread that attached."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class TracerThread(Generic[T]):
    """Work that traces a node, in a thread of its own: ptrace belongs to a thread.

    Args:
        work: gets a function to call once the node runs towards what is awaited.
    """

    def __init__(self, work: Callable[[Callable[[], None]], T]) -> None:
        self._armed = threading.Event()
        self._result: list[T] = []
        self._error: BaseException | None = None

        def run() -> None:
            """The thread's whole life."""
            try:
                self._result.append(work(self._armed.set))
            except BaseException as error:  # the thread's boundary: who awaits it raises it again
                self._error = error
            finally:
                self._armed.set()

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def await_armed(self) -> None:
        """Wait until the node runs towards what is awaited; raises what went wrong before."""
        self._armed.wait()
        if self._error is not None:
            raise self._error

    def result(self) -> T:
        """Wait for the end of the work, and raise what it raised."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._result[0]
