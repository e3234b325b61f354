"""Acts on a process after some wall or CPU time, from another thread, while the tracer waits.

It serves the time limits of faulty runs, and the triggers of the cpu-time and wall-clock sampling
rules.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from types import TracebackType

from mavfi_cli.fi.tracer import linux


class ProcessTimer:
    """A timer on one process; leaving its context cancels it.

    It fires when the process has used `cpu_s` of CPU time since the timer was set, or when
    `wall_s` have passed, whichever is set and comes first. `fired` is true once it has.
    """

    def __init__(
        self, pid: int, number: signal.Signals, *, cpu_s: float | None, wall_s: float | None
    ) -> None:
        self.fired = False
        self._pid = pid
        self._signal = number
        self._process = os.pidfd_open(pid)
        self._cpu_end = None if cpu_s is None else linux.cpu_time_s(pid) + cpu_s
        self._wall_end = None if wall_s is None else time.monotonic() + wall_s
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> ProcessTimer:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._cancelled.set()
        self._thread.join()
        os.close(self._process)

    def _watch(self) -> None:
        while (left := self._left_s()) > 0:
            if self._cancelled.wait(left):
                return
        self.fired = True
        try:
            signal.pidfd_send_signal(self._process, self._signal)
        except ProcessLookupError:
            self.fired = False  # the process had ended

    def _left_s(self) -> float:
        """Lower bound of the time left; CPU time passes no faster than wall time."""
        left = []
        if self._cpu_end is not None:
            left.append(self._cpu_end - linux.cpu_time_s(self._pid))
        if self._wall_end is not None:
            left.append(self._wall_end - time.monotonic())
        return min(left)
