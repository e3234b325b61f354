"""The compiled single-step loop, in which a step costs little more than its system calls.

The loop returns to Python for code out of scope, a system call, a push or pop of the flags, or a
signal. `ptrace` and `wait4` are resolved by name at run time, so the compiled loop can be cached.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from mavfi_cli.fi.tracer import linux

_PEEKTEXT, _PEEKUSER, _SINGLESTEP = 1, 3, 9
_OF_OWN_THREAD = 0x6000_0000  # __WALL and __WNOTHREAD, as in `Tracee`
_STOPPED_BY_STEP = 0x057F  # wait status: stopped by SIGTRAP

# Why the loop returned: the trace is full, code out of scope is next, a step over the next
# instruction would change the target, the report was not that of a step, or the window has ended.
FULL, OUT_OF_SCOPE, NEEDS_CARE, OTHER_STATUS, WINDOW_END = 0, 1, 2, 3, 4
_IP, _SP = 128, 152  # offsets in `struct user`
NO_END = np.array([-1, 0], np.int64)
"""The argument `stop` for a window without an end."""

_ptrace: Any = types.ExternalFunction(
    "ptrace", types.int64(types.int64, types.int64, types.uint64, types.uint64)
)
_wait4: Any = types.ExternalFunction(
    "wait4", types.int32(types.int32, types.uint64, types.int32, types.uint64)
)


@compiled
def _is_repeated(word: int) -> bool:
    """Return True if `word` begins a repeated string instruction (Intel SDM volume 2, REP)."""
    first = word & 0xFF
    if first != 0xF2 and first != 0xF3:
        return False
    code = (word >> 8) & 0xFF
    if 0x40 <= code <= 0x4F:
        code = (word >> 16) & 0xFF
    return 0xA4 <= code <= 0xA7 or 0xAA <= code <= 0xAF


@compiled
def _needs_care(word: int) -> bool:
    """Return True if `word` begins a push or pop of the flags, or a system call."""
    first = word & 0xFF
    second = (word >> 8) & 0xFF
    code = second if first == 0x66 or 0x40 <= first <= 0x4F else first
    return code == 0x9C or code == 0x9D or (first == 0x0F and second == 0x05)


@compiled
def _run(
    tid: int,
    group: int,
    spans: NDArray[np.int64],
    trace: NDArray[np.int64],
    stop: NDArray[np.int64],
    report: NDArray[np.int32],  # (2,) thread and status of the last report
) -> tuple[int, int]:
    recorded = 0
    repeating = np.int64(-1)
    while True:
        ip = _ptrace(_PEEKUSER, tid, _IP, 0)
        if ip == stop[0] and _ptrace(_PEEKUSER, tid, _SP, 0) > stop[1]:
            return recorded, WINDOW_END
        for place in range(2, stop.shape[0]):
            if ip == stop[place]:
                return recorded, WINDOW_END
        if ip != repeating:
            repeating = np.int64(-1)
            inside = False
            for row in range(spans.shape[0]):
                inside = inside or (spans[row, 0] <= ip < spans[row, 1])
            if not inside:
                return recorded, OUT_OF_SCOPE
            if recorded == trace.shape[0]:
                return recorded, FULL
            word = _ptrace(_PEEKTEXT, tid, ip, 0)
            if _needs_care(word):
                return recorded, NEEDS_CARE
            trace[recorded] = ip
            recorded += 1
            if _is_repeated(word):
                repeating = ip
        _ptrace(_SINGLESTEP, tid, 0, 0)
        report[0] = _wait4(group, report.ctypes.data + report.itemsize, _OF_OWN_THREAD, 0)
        if report[0] != tid or report[1] != _STOPPED_BY_STEP:
            return recorded, OTHER_STATUS


def load() -> None:
    """Load the compiled loop from the cache, or compile it, which takes seconds."""
    # Thread 0 does not exist: its pointers read as -1, where this window ends before any wait.
    ends_at_once = np.array([-1, -2], np.int64)
    record_steps(0, 0, np.empty((0, 2), np.int64), np.empty(0, np.int64), ends_at_once)


def record_steps(
    tid: int,
    group: int,
    spans: NDArray[np.int64],
    trace: NDArray[np.int64],
    stop: NDArray[np.int64],
) -> tuple[int, int, linux.Status]:
    """Single-step a stopped thread, and record each instruction's address before it executes.

    Args:
        group: `Tracee.group`. A report about another of its threads ends the recording, because
            Linux reports the end of a process only after the ends of its threads have been read.
        spans: (n, 2) addresses in scope.
        trace: (m,) filled from the start; a repeated string instruction is one entry.
        stop: (2 + n,) an address, a stack pointer and n further addresses. The window ends at the
            first address if the stack pointer is above the given one, and at any further address.

    Returns:
        The number of recorded addresses, why the recording ended, and the last report.
    """
    report = np.zeros(2, np.int32)
    recorded, why = _run(tid, group, spans, trace, stop, report)
    return int(recorded), int(why), linux.Status(int(report[0]), int(report[1]))
