"""The compiled single-step loop: a step costs little more than its system calls.

The loop returns to Python for code out of scope, a system call, a push of the flags or a signal.
`ptrace` and `wait4` are resolved by name at run time, so the compiled loop can be cached.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

PEEKTEXT, PEEKUSER, SINGLESTEP, WALL = 1, 3, 9, 0x4000_0000
STOPPED_BY_STEP = 0x057F  # wait status: stopped by SIGTRAP

FULL, OUT_OF_SCOPE, NEEDS_CARE, OTHER_STATUS, WINDOW_END = 0, 1, 2, 3, 4

_ptrace: Any = types.ExternalFunction(
    "ptrace", types.int64(types.int64, types.int64, types.uint64, types.uint64)
)
_wait4: Any = types.ExternalFunction(
    "wait4", types.int32(types.int32, types.uint64, types.int32, types.uint64)
)


def _is_repeated(word: int) -> bool:
    """True for F2 or F3, an optional REX prefix and a string opcode (Intel SDM volume 2, REP)."""
    first = word & 0xFF
    if first != 0xF2 and first != 0xF3:
        return False
    code = (word >> 8) & 0xFF
    if 0x40 <= code <= 0x4F:
        code = (word >> 16) & 0xFF
    return 0xA4 <= code <= 0xA7 or 0xAA <= code <= 0xAF


def _needs_care(word: int) -> bool:
    """True for a push or a pop of the flags, or a system call."""
    first = word & 0xFF
    second = (word >> 8) & 0xFF
    code = second if first == 0x66 or 0x40 <= first <= 0x4F else first
    return code == 0x9C or code == 0x9D or (first == 0x0F and second == 0x05)


is_repeated: Any = njit(cache=True)(_is_repeated)
needs_care: Any = njit(cache=True)(_needs_care)


def _run(
    tid: int,
    spans: NDArray[np.int64],
    trace: NDArray[np.int64],
    stop: NDArray[np.int64],
    offsets: NDArray[np.int64],
    status: NDArray[np.int32],
) -> tuple[int, int]:
    """Step and record the address of each instruction in scope, before it executes.

    Args:
        tid: the stopped thread.
        spans: (n, 2) addresses in scope.
        trace: (m,) filled from the start.
        stop: (2 + m,) the window ends at the first address once the stack pointer is above the
            second number, and at each of the other addresses.
        offsets: (2,) offsets of instruction and stack pointer in `struct user`.
        status: (1,) the last wait status, if it is not a plain step.

    Returns:
        The number of recorded addresses, and why the loop ended.
    """
    recorded = 0
    repeating = np.int64(-1)
    while True:
        ip = _ptrace(PEEKUSER, tid, offsets[0], 0)
        if ip == stop[0] and _ptrace(PEEKUSER, tid, offsets[1], 0) > stop[1]:
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
            word = _ptrace(PEEKTEXT, tid, ip, 0)
            if needs_care(word):
                return recorded, NEEDS_CARE
            trace[recorded] = ip
            recorded += 1
            if is_repeated(word):
                repeating = ip
        _ptrace(SINGLESTEP, tid, 0, 0)
        _wait4(tid, status.ctypes.data, WALL, 0)
        if status[0] != STOPPED_BY_STEP:
            return recorded, OTHER_STATUS


run: Any = njit(cache=True)(_run)
