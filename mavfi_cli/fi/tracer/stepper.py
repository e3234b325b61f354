"""Compiled loops that execute code in scope and record the address of each executed instruction.

`record_steps` single-steps a thread of any process. `record_blocks` needs a process with one thread
and about a fifth of the stops, each of which costs two context switches. It puts a breakpoint on
the instruction that ends the straight-line code ahead, and lets the thread run to it. Most of these
instructions are jumps, whose target it computes itself from the flags.

Both return to Python for code out of scope, a system call or a signal. `ptrace` and `wait4` are
resolved by name at run time, so the compiled loops can be cached.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.counted import FIXED
from mavfi_cli.fi.tracer.decode import BRANCHES, engine

_PEEKTEXT, _PEEKUSER, _POKETEXT, _POKEUSER, _CONT, _SINGLESTEP = 1, 3, 4, 6, 7, 9
_OF_OWN_THREAD = 0x6000_0000  # __WALL and __WNOTHREAD, as in `Tracee`
_STOPPED_BY_STEP = 0x057F  # wait status: stopped by SIGTRAP

# Why a loop returned: the trace is full, code out of scope is next, a step over the next
# instruction would change the target, the report was not the awaited one, the window has ended, or
# the block ahead has not been decoded yet.
FULL, OUT_OF_SCOPE, NEEDS_CARE, OTHER_STATUS, WINDOW_END, NEW_BLOCK = 0, 1, 2, 3, 4, 5
_IP, _FLAGS, _SP = 128, 144, 152  # offsets in `struct user`
_INT3 = 0xCC
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
def _ends_at(tid: int, ip: int, stop: NDArray[np.int64]) -> bool:
    """Return True if the window ends before the instruction at `ip`."""
    ends = ip == stop[0] and _ptrace(_PEEKUSER, tid, _SP, 0) > stop[1]
    for place in range(2, stop.shape[0]):
        ends = ends or ip == stop[place]
    return bool(ends)


@compiled
def _resume(tid: int, group: int, request: int, report: NDArray[np.int32]) -> bool:
    """Resume the thread and wait. Return True if a breakpoint or a finished step stopped it."""
    _ptrace(request, tid, 0, 0)
    report[0] = _wait4(group, report.ctypes.data + report.itemsize, _OF_OWN_THREAD, 0)
    return bool(report[0] == tid and report[1] == _STOPPED_BY_STEP)


@functools.partial(compiled, releases_gil=True)  # a step may wait for the target
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
        if _ends_at(tid, ip, stop):
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
        if not _resume(tid, group, _SINGLESTEP, report):
            return recorded, OTHER_STATUS


# -- blocks

# How a block ends: another block begins there, or with a jump, a conditional jump, an instruction
# that is stepped, or one that `clean_step` must execute.
_ANOTHER, _JUMP, _CONDITIONAL, _STEPPED, _CARE = 0, 1, 2, 3, 4
# Columns of a block: the address of its end, its place in the code in scope, and the byte there;
# how it ends; the jump's target and condition (Intel SDM volume 2, B.1.4.7); the address after the
# end; the first of its other instructions among the members, and their number.
_END, _PLACE, _BYTE, _HOW, _TARGET, _CONDITION, _NEXT, _FIRST, _COUNT = range(9)
_LONGEST = 512  # instructions of a block


@compiled
def _poke_byte(tid: int, address: int, byte: int) -> None:
    """Write one byte of the target's code. An aligned word never extends into another page."""
    place = address & ~7
    shift = np.uint64(8 * (address & 7))
    word = np.uint64(_ptrace(_PEEKTEXT, tid, place, 0))
    word = (word & ~(np.uint64(0xFF) << shift)) | (np.uint64(byte) << shift)
    _ptrace(_POKETEXT, tid, place, word)


@compiled
def _holds(condition: int, flags: int) -> bool:
    """Return True if a jump condition holds."""
    carry, parity, zero = flags & 1, (flags >> 2) & 1, (flags >> 6) & 1
    sign, overflow = (flags >> 7) & 1, (flags >> 11) & 1
    kind = condition >> 1
    if kind == 0:
        holds = overflow
    elif kind == 1:
        holds = carry
    elif kind == 2:
        holds = zero
    elif kind == 3:
        holds = carry | zero
    elif kind == 4:
        holds = sign
    elif kind == 5:
        holds = parity
    elif kind == 6:
        holds = sign ^ overflow
    else:
        holds = zero | (sign ^ overflow)
    return (holds ^ (condition & 1)) == 1


@compiled
def _row_at(ip: int, spans: NDArray[np.int64], rows: NDArray[np.int32]) -> int:
    """Return the row of the block at `ip`, or minus the reason to return to Python."""
    before = 0
    for span in range(spans.shape[0]):
        if spans[span, 0] <= ip < spans[span, 1]:
            return int(rows[before + ip - spans[span, 0]]) or -NEW_BLOCK
        before += spans[span, 1] - spans[span, 0]
    return -OUT_OF_SCOPE


@compiled
def _leave_block(tid: int, block: NDArray[np.int64], covered: NDArray[np.bool_]) -> int:
    """Make the jump that ends a block, or go to its end and restore the code there.

    Returns the address at which execution continues.
    """
    ip = block[_END]
    if block[_HOW] == _JUMP:
        ip = block[_TARGET]
    elif block[_HOW] == _CONDITIONAL:
        taken = _holds(block[_CONDITION], _ptrace(_PEEKUSER, tid, _FLAGS, 0))
        ip = block[_TARGET] if taken else block[_NEXT]
    elif covered[block[_PLACE]]:
        _poke_byte(tid, ip, block[_BYTE])
        covered[block[_PLACE]] = False
    _ptrace(_POKEUSER, tid, _IP, ip)
    return int(ip)


@compiled
def _executed(ip: int, members: NDArray[np.int64]) -> int:
    """Return how many of a block's instructions come before `ip`; all if none is at `ip`."""
    for number in range(len(members)):
        if members[number] == ip:
            return number
    return len(members)


@functools.partial(compiled, releases_gil=True)
def _run_blocks(
    tid: int,
    group: int,
    spans: NDArray[np.int64],
    rows: NDArray[np.int32],  # (bytes in scope,) row of the block that begins there; 0 if unknown
    covered: NDArray[np.bool_],  # (bytes in scope,) True where a breakpoint is set
    blocks: NDArray[np.int64],
    members: NDArray[np.int64],
    trace: NDArray[np.int64],
    stop: NDArray[np.int64],
    report: NDArray[np.int32],
) -> tuple[int, int]:
    recorded = 0
    ip = _ptrace(_PEEKUSER, tid, _IP, 0)
    while True:
        if _ends_at(tid, ip, stop):
            return recorded, WINDOW_END
        row = _row_at(ip, spans, rows)
        if row < 0:
            return recorded, -row
        block = blocks[row]
        end, place, how, count = block[_END], block[_PLACE], block[_HOW], block[_COUNT]
        if recorded + count + 1 > trace.shape[0]:
            return recorded, FULL
        if count:
            if not covered[place]:
                _poke_byte(tid, end, _INT3)
                covered[place] = True
            own = members[block[_FIRST] : block[_FIRST] + count]
            trapped = _resume(tid, group, _CONT, report)
            executed = _executed(_ptrace(_PEEKUSER, tid, _IP, 0), own)
            trace[recorded : recorded + executed] = own[:executed]
            recorded += executed
            if not trapped or executed < count:
                return recorded, OTHER_STATUS
        ip = _leave_block(tid, block, covered)
        if how == _CARE:
            return recorded, NEEDS_CARE
        if how != _ANOTHER:
            trace[recorded] = end
            recorded += 1
        if how == _STEPPED:
            if not _resume(tid, group, _SINGLESTEP, report):
                return recorded, OTHER_STATUS
            ip = _ptrace(_PEEKUSER, tid, _IP, 0)


class Blocks:
    """The straight-line code in scope, decoded where the target reaches it.

    Args:
        code: the code of each span in scope, by its start address.
        ends: further addresses at which blocks end, because windows may end there.
    """

    def __init__(self, code: Mapping[int, bytes], ends: Collection[int]) -> None:
        self._code, self._ends = code, frozenset(ends)
        self._spans = np.array([[at, at + len(data)] for at, data in code.items()], np.int64)
        size = sum(map(len, code.values()))
        self._rows, self._covered = np.zeros(size, np.int32), np.zeros(size, np.bool_)
        self._blocks, self._count = np.zeros((256, 9), np.int64), 1  # row 0 is no block
        self._members, self._used = np.zeros(4096, np.int64), 0

    def add(self, start: int) -> None:
        """Decode the block that begins at an address in scope."""
        before = 0
        for first, code in self._code.items():
            if 0 <= start - first < len(code):
                break
            before += len(code)
        end, members, after = start, list[int](), _Next(0, _ANOTHER)
        while end == start or (end not in self._ends and len(members) < _LONGEST):
            after = _next_of(code[end - first : end - first + 16], end)
            if after.how != _ANOTHER or end + after.size - first >= len(code):
                break
            members.append(end)
            end += after.size
        else:
            after = _Next(0, _ANOTHER)
        if after.size and after.how == _ANOTHER:  # the last instruction of the span
            after = replace(after, how=_STEPPED)
        if self._count == len(self._blocks):
            self._blocks = np.concatenate([self._blocks, np.zeros_like(self._blocks)])
        if self._used + len(members) > len(self._members):
            self._members = np.concatenate([self._members, np.zeros_like(self._members)])
        self._rows[before + start - first] = self._count
        self._blocks[self._count] = (
            end, before + end - first, code[end - first], after.how, after.target, after.condition,
            end + after.size, self._used, len(members),
        )  # fmt: skip
        self._members[self._used : self._used + len(members)] = members
        self._used, self._count = self._used + len(members), self._count + 1

    def record(
        self, tid: int, group: int, trace: NDArray[np.int64], stop: NDArray[np.int64]
    ) -> tuple[int, int, linux.Status]:
        """Run the only thread of a process, and record each executed instruction's address.

        Breakpoints remain in the code. Arguments and results are those of `record_steps`.
        """
        report = np.zeros(2, np.int32)
        recorded, why = _run_blocks(
            tid, group, self._spans, self._rows, self._covered, self._blocks, self._members, trace,
            stop, report,
        )  # fmt: skip
        return int(recorded), int(why), linux.Status(int(report[0]), int(report[1]))

    def forget_breakpoints(self) -> None:
        """Note that the code has been restored."""
        self._covered[self._blocks[1 : self._count, _PLACE]] = False


@dataclass(frozen=True, slots=True)
class _Next:
    """How execution goes on after one instruction; see the columns of a block."""

    size: int
    how: int  # _ANOTHER: with the next instruction
    target: int = 0
    condition: int = 0


@functools.lru_cache(maxsize=65536)
def _next_of(code: bytes, address: int) -> _Next:
    """Decode how execution goes on after the instruction whose code is at the start of `code`."""
    decoded = next(engine.disasm(code, address, 1), None)
    if decoded is None:
        return _Next(1, _STEPPED)
    size = decoded.size
    if BRANCHES.isdisjoint(decoded.groups) and decoded.mnemonic not in FIXED:
        return _Next(size, _ANOTHER)
    if code[:2] == b"\x0f\x05":
        return _Next(size, _CARE)
    near = int.from_bytes(code[1:size], "little", signed=True)
    if (code[0], size) in ((0xEB, 2), (0xE9, 5)):
        return _Next(size, _JUMP, address + size + near)
    if code[0] >> 4 == 7 and size == 2:
        return _Next(size, _CONDITIONAL, address + size + near, code[0] & 15)
    if code[0] == 0x0F and code[1] >> 4 == 8 and size == 6:
        near = int.from_bytes(code[2:6], "little", signed=True)
        return _Next(size, _CONDITIONAL, address + size + near, code[1] & 15)
    return _Next(size, _STEPPED)


def load() -> None:
    """Load the compiled loops from the cache, or compile them, which takes seconds."""
    # Thread 0 does not exist: its pointers read as -1, where this window ends before any wait.
    ends_at_once = np.array([-1, -2], np.int64)
    record_steps(0, 0, np.empty((0, 2), np.int64), np.empty(0, np.int64), ends_at_once)
    Blocks({0: b""}, ()).record(0, 0, np.empty(0, np.int64), ends_at_once)


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
