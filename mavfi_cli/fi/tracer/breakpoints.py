"""Execution breakpoints that stop exactly before the k-th execution of an instruction.

There are two mechanisms, the better first. `PERF`: the kernel counts the hits of a hardware
breakpoint and raises SIGTRAP on the k-th (`perf_event_open` with `sigtrap`, Linux 5.13,
perf_event_open(2)). It needs no performance counter, so it works in virtual machines. `DEBUG`: the
tracer writes the debug register itself and counts, with one stop a hit.
"""

from __future__ import annotations

import ctypes
import os
import struct
from enum import Enum

from mavfi_cli.fi.tracer.arch import TRAITS

TRAP_BRKPT, TRAP_TRACE, TRAP_HWBKPT, TRAP_PERF, SI_KERNEL = 1, 2, 4, 6, 0x80

_TYPE_BREAKPOINT, _EXECUTE, _CLOSE_ON_EXEC = 5, 4, 8
_DISABLED_AT_EXEC_END = 1 << 36 | 1 << 37  # remove_on_exec, sigtrap
_USER_ONLY = 1 << 5 | 1 << 6  # exclude_kernel, exclude_hv
_ATTRIBUTES = struct.Struct("<IIQQQQQIIQQ56x")  # perf_event_attr, version 7: 128 bytes

_libc = ctypes.CDLL(None, use_errno=True)


class Mechanism(Enum):
    """How executions are counted."""

    PERF = "perf"
    DEBUG = "debug-registers"


def _open_event(tid: int, address: int, period: int, extra: int) -> int:
    attributes = _ATTRIBUTES.pack(
        _TYPE_BREAKPOINT, 128, 0, period, 0, 0, _USER_ONLY | extra, 0, _EXECUTE, address,
        TRAITS.breakpoint_length,
    )  # fmt: skip
    flags = ctypes.c_ulong(_CLOSE_ON_EXEC)
    fd = int(_libc.syscall(TRAITS.perf_event_open, attributes, tid, -1, -1, flags))
    if fd < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return fd


class PerfBreakpoint:
    """Traps the thread before execution number `count` of the instruction at `address`."""

    def __init__(self, tid: int, address: int, count: int) -> None:
        self._fd = _open_event(tid, address, count, _DISABLED_AT_EXEC_END)

    def close(self) -> None:
        """Remove the breakpoint."""
        os.close(self._fd)


class ExecutionCounter:
    """Counts the executions of one instruction without stopping it, for checks."""

    def __init__(self, tid: int, address: int) -> None:
        self._fd = _open_event(tid, address, 0, 0)

    def read(self) -> int:
        """Executions since the counter was opened; valid after the thread's end too."""
        return int.from_bytes(os.read(self._fd, 8), "little")

    def close(self) -> None:
        """Remove the counter."""
        os.close(self._fd)


def perf_allowed() -> str | None:
    """None if counted breakpoints can be opened, else the reason why not."""
    try:
        os.close(_open_event(0, 0x1000, 1_000_000, _DISABLED_AT_EXEC_END))
    except OSError as error:
        return str(error)
    return None
