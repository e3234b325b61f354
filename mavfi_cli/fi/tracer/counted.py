"""Counts executions of instructions, either up to a stop or over a whole run.

The k-th execution of an instruction is reached by counting. A *detour* counts inside the target, in
a few nanoseconds per execution. A jump to a page that the tracer has mapped replaces the bytes of
the counted instruction. The code there counts down without changing flags or stack, executes the
replaced instructions and jumps back. At zero it stops at a breakpoint instead. No jump may lead
into the middle of the replaced instructions. If they are shorter than five bytes, a short jump
leads to five unused bytes nearby, which hold a second jump.

If a program is too long to be stepped, faults are drawn from its execution counts. Instructions of
a block always execute together, so their counts are equal. A frequent instruction can therefore be
counted at any instruction of its block where a detour fits.
"""

from __future__ import annotations

import functools
import struct
from bisect import bisect_left
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from capstone import x86
from numpy.typing import NDArray

from mavfi_cli.fi.tracer.decode import BRANCHES, engine
from mavfi_cli.fi.tracer.image import Location

Locate = Callable[[int], Location]
CodeAt = Callable[[int], bytes]  # 16 bytes of code
Executions = Callable[[int], int | None]  # of the instruction at an address

_BY_BREAKPOINT = 100_000  # maximum executions counted by a breakpoint: about a second
_JUMP_BYTES, _SHORT_JUMP_BYTES = 5, 2
_SHORT_JUMP = range(-126, 130)  # reach of a short jump, from its own address
_PAGE = 4096
_SAVED, _COUNTER, _RETURN = 0, 8, 16  # offsets in the data page
FIXED = frozenset(("syscall", "sysenter", "int", "int3", "hlt", "ud2", "xbegin", "xabort", "xend"))


@dataclass(frozen=True, slots=True, kw_only=True)
class _DetourCode:
    """The bytes of a detour, and where it stops."""

    jumps: dict[int, bytes]  # by address, in the code of the program
    pages: dict[int, bytes]  # by address
    stop: int  # instruction pointer when the count has reached zero


class Counting(Enum):
    """Counting methods, fastest first; the fastest changes the most code."""

    FAR_DETOUR = "detour over unused bytes"
    DETOUR = "detour"
    BREAKPOINT = "breakpoint"


@dataclass(frozen=True, slots=True)
class Detour:
    """The location of a detour that counts the executions of an instruction.

    Attributes:
        size: bytes of the instructions that the detour replaces; no jump leads into their middle.
        via: distance from the instruction to the unused bytes that hold a second jump; 0 if one
            jump is enough.
    """

    size: int
    via: int = 0

    @property
    def counting(self) -> Counting:
        """The counting method; a detour with a second jump is a `FAR_DETOUR`."""
        return Counting.FAR_DETOUR if self.via else Counting.DETOUR

    @classmethod
    def at(cls, address: int, code_at: CodeAt, executions: Executions) -> Detour | None:
        """Return the detour at the instruction at `address`, or None if no detour fits there."""
        size = _straight_bytes(address, code_at, executions)
        return cls(size) if size >= _JUMP_BYTES else None

    def code(self, code: bytes, address: int, pages: int, count: int) -> _DetourCode | None:
        """Assemble the detour that stops the program before execution `count` of an instruction.

        Args:
            code: the replaced instructions; only the last may be a branch.
            address: address of the counted instruction.
            pages: address of two pages of memory, less than 2 GB away.

        Returns:
            None if an instruction cannot be relocated.
        """
        start = pages + _PAGE  # code next to written data would be slow
        parts = [
            _rcx(b"\x89", pages + _SAVED, start),
            _rcx(b"\x8b", pages + _COUNTER, start + 7),
            b"\x48\x8d\x49\xff",  # lea rcx, [rcx-1]
            _rcx(b"\x89", pages + _COUNTER, start + 18),
        ]
        moved = _rcx(b"\x8b", pages + _SAVED, start + 27)
        at = address
        returns_to = address + len(code)
        for decoded in engine.disasm(code, address):
            piece = _moved(decoded, start + 27 + len(moved), pages + _RETURN)
            if piece is None:
                return None
            moved += piece
            at = decoded.address + decoded.size
        if at != returns_to:
            return None
        moved += _jump(returns_to, start + 27 + len(moved))
        if len(moved) > 127:
            return None
        stop = start + 27 + len(moved)
        parts += [b"\xe3" + bytes([len(moved)]), moved]  # jrcxz
        parts += [_rcx(b"\x8b", pages + _SAVED, stop), b"\xcc"]
        jumps = {address + self.via: _jump(start, address + self.via)}
        if self.via:
            jumps[address] = b"\xeb" + struct.pack("<b", self.via - _SHORT_JUMP_BYTES)
        return _DetourCode(
            jumps=jumps,
            pages={pages: struct.pack("<QQQ", 0, count, returns_to), start: b"".join(parts)},
            stop=stop + 8,
        )


@dataclass(frozen=True, slots=True)
class CountedStop:
    """A stop before `location` executes for the `count`-th time since the previous stage."""

    location: Location
    count: int
    detour: Detour | None = None  # None: a breakpoint counts the executions


# -- control flow


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flow:
    """Control flow through one instruction, and whether it can be relocated."""

    size: int
    straight: bool  # always followed by the next instruction
    movable: bool
    repeated: bool  # a repeated string instruction


@functools.lru_cache(maxsize=65536)
def _flow(code: bytes, address: int) -> _Flow | None:
    """Return the control flow of the instruction in `code`, or None if `code` is no instruction."""
    decoded = next(engine.disasm(code[:16], address, 1), None)
    if decoded is None:
        return None
    leaves = not BRANCHES.isdisjoint(decoded.groups)
    return _Flow(
        size=decoded.size,
        straight=not leaves and decoded.mnemonic not in FIXED,
        movable=_moved(decoded, address, address) is not None,
        repeated=decoded.mnemonic.startswith("rep") and not leaves,
    )


def _rcx(opcode: bytes, place: int, at: int) -> bytes:
    """Return the instruction that, placed at `at`, loads or stores rcx at address `place`."""
    return b"\x48" + opcode + b"\x0d" + struct.pack("<i", place - at - 7)


def _jump(target: int, at: int) -> bytes:
    return b"\xe9" + struct.pack("<i", target - at - 5)


def _moved(decoded: Any, at: int, return_slot: int) -> bytes | None:
    """Return the instruction's bytes at its new address `at`, or None if it cannot be moved.

    `return_slot` is the address at which a moved call finds its return address.
    """
    raw = bytes(decoded.bytes)
    if decoded.mnemonic in FIXED:
        return None
    immediate = bool(decoded.operands) and decoded.operands[0].type == x86.X86_OP_IMM
    if decoded.group(x86.X86_GRP_CALL):
        if not immediate:
            return None
        push = b"\xff\x35" + struct.pack("<i", return_slot - at - 6)  # the true return address
        return push + _jump(decoded.operands[0].imm, at + 6)
    if decoded.group(x86.X86_GRP_BRANCH_RELATIVE) and immediate:
        target = decoded.operands[0].imm
        first, second = decoded.opcode[0], decoded.opcode[1]
        if first in (0xE9, 0xEB):
            return _jump(target, at)
        if first >> 4 != 7 and not (first == 0x0F and second >> 4 == 8):
            return None  # loop, jrcxz
        condition = (first if first >> 4 == 7 else second) & 15
        return bytes([0x0F, 0x80 | condition]) + struct.pack("<i", target - at - 6)
    if any(op.type == x86.X86_OP_MEM and op.mem.base == x86.X86_REG_RIP for op in decoded.operands):
        place = decoded.disp_offset
        there = decoded.disp + decoded.address - at
        if raw[place : place + 4] != struct.pack("<i", decoded.disp) or abs(there) >> 31:
            return None
        return raw[:place] + struct.pack("<i", there) + raw[place + 4 :]
    return raw


# -- a whole run


@dataclass(frozen=True, kw_only=True, eq=False)
class CountedRun:
    """Execution counts of the instructions in scope, over one run.

    Attributes:
        addresses: (n,) instructions, ascending.
        counts: (n,) executions.
        places: (n,) index of the instruction at which the executions are counted.
        detours: (n,) detour that counts the instruction; None if none fits.
        joined: (n,) whether the next instruction always follows this one, and follows no other.
    """

    addresses: NDArray[np.int64]
    counts: NDArray[np.int64]
    places: NDArray[np.int64]
    detours: tuple[Detour | None, ...]
    joined: tuple[bool, ...]

    @classmethod
    def of(cls, executions: Mapping[int, int], code_at: CodeAt) -> CountedRun:
        """Create a run from the execution counts of its instructions, keyed by address."""
        addresses = sorted(executions)
        flows = [_flow(code_at(address), address) for address in addresses]
        counts = _without_repeats(addresses, [executions[address] for address in addresses], flows)
        joined = _joined(addresses, counts, flows)
        known = dict(zip(addresses, counts, strict=True))
        sizes = [_straight_bytes(address, code_at, known.get) for address in addresses]
        detours = tuple(_detours(addresses, sizes, flows))
        return cls(
            addresses=np.array(addresses, np.int64),
            counts=np.array(counts, np.int64),
            places=np.array(_places(detours, joined), np.int64),
            detours=detours,
            joined=tuple(joined),
        )

    def without(self, methods: Container[Counting]) -> CountedRun:
        """Return the same run without the counting methods in `methods`.

        Fewer executions can then be reached.
        """
        detours = [
            None if detour and detour.counting in methods else detour for detour in self.detours
        ]
        places = np.array(_places(detours, self.joined), np.int64)
        return replace(self, detours=tuple(detours), places=places)

    @functools.cached_property
    def reached(self) -> NDArray[np.int64]:
        """Number of reachable executions of each instruction, as an array of shape (n,).

        They are the first executions of the instruction.
        """
        detoured = np.array([self.detours[place] is not None for place in self.places])
        return np.where(detoured, self.counts, np.minimum(self.counts, _BY_BREAKPOINT))

    @functools.cached_property
    def _ends(self) -> NDArray[np.int64]:
        return np.cumsum(self.reached)

    @property
    def executed(self) -> int:
        """Number of executed instructions that can be reached."""
        return int(self._ends[-1]) if len(self._ends) else 0

    @property
    def not_reached(self) -> float:
        """Share of the executed instructions that cannot be reached."""
        return 1.0 - self.executed / max(1, int(self.counts.sum()))

    def _at(self, position: int) -> tuple[int, int]:
        """Return the index of the instruction at `position`, and its execution number, from 1."""
        index = int(np.searchsorted(self._ends, position, side="right"))
        return index, position - int(self._ends[index] - self.reached[index]) + 1

    def address(self, position: int) -> int:
        """Return the address of the executed instruction at `position`, from 0."""
        return int(self.addresses[self._at(position)[0]])

    def trigger(
        self, position: int, locate: Locate, _: CodeAt
    ) -> tuple[tuple[CountedStop, ...], int]:
        """Return the trigger for the executed instruction at `position`, and its number k.

        The number is that of the execution, from 1.
        """
        index, k = self._at(position)
        return self.stages(index, k, locate), k

    def stages(self, index: int, k: int, locate: Locate) -> tuple[CountedStop, ...]:
        """Return the stages of a trigger that stops before execution `k` of instruction `index`."""
        place = int(self.places[index])
        here, there = (locate(int(self.addresses[at])) for at in (index, place))
        detour = self.detours[place]
        if place == index:
            return (CountedStop(here, k, detour),)
        before = k if place < index else k - 1  # executions of the counted instruction until then
        first = (CountedStop(there, before, detour),) if before else ()
        return (*first, CountedStop(here, 1))


def _straight_bytes(address: int, code_at: CodeAt, executions: Executions) -> int:
    """Return the number of bytes from `address` on that a detour may replace."""
    size, expected = 0, None
    while (how := _flow(code_at(address + size), address + size)) is not None and how.movable:
        size += how.size
        if size >= _JUMP_BYTES or not how.straight:
            return size
        expected = expected or executions(address)
        if executions(address + size) != expected:
            return size
    return size if how is not None else 0


def _without_repeats(
    addresses: list[int], counts: list[int], flows: list[_Flow | None]
) -> list[int]:
    """Return the counts, with a repeated string instruction counted once per execution.

    In `counts`, it is counted once per iteration.
    """
    counts = list(counts)
    for at, how in enumerate(flows):
        if how is None or not how.repeated or at + 1 == len(addresses):
            continue
        if addresses[at + 1] == addresses[at] + how.size:
            counts[at] = min(counts[at], counts[at + 1])
    return counts


def _joined(addresses: list[int], counts: list[int], flows: list[_Flow | None]) -> list[bool]:
    """Return, for each instruction, whether it and the next one always execute together."""
    joined = [
        how is not None
        and how.straight
        and addresses[at + 1] == addresses[at] + how.size
        and counts[at + 1] == counts[at]
        for at, how in enumerate(flows[:-1])
    ]
    return [*joined, False][: len(flows)]


def _detours(
    addresses: list[int], sizes: list[int], flows: list[_Flow | None]
) -> Iterator[Detour | None]:
    """Yield, for each instruction, a detour that can count it, or None if no detour fits."""
    ends = [at + how.size if how else at for at, how in zip(addresses, flows, strict=True)]
    gaps = [
        range(end, start - _JUMP_BYTES + 1)
        for end, start in zip(ends, addresses[1:], strict=False)
        if start - end >= _JUMP_BYTES
    ]
    starts = [gap.start for gap in gaps]
    for address, size in zip(addresses, sizes, strict=True):
        if size >= _JUMP_BYTES:
            yield Detour(size)
        elif size >= _SHORT_JUMP_BYTES:
            near = range(address + _SHORT_JUMP.start, address + _SHORT_JUMP.stop)
            yield _over_gap(
                address, size, gaps[max(0, bisect_left(starts, near.start) - 1) :], near
            )
        else:
            yield None


def _over_gap(address: int, size: int, gaps: Sequence[range], near: range) -> Detour | None:
    """Return a detour through the first unused bytes in reach, or None if none are in reach."""
    for gap in gaps:
        first = max(gap.start, near.start)
        if first >= near.stop:
            return None
        if first in gap:
            return Detour(size, first - address)
    return None


def _places(detours: Sequence[Detour | None], joined: Sequence[bool]) -> list[int]:
    """Return, for each instruction, the index of the one that is counted: itself or a neighbour.

    The neighbour is in the same block, so it executes equally often.
    """
    places: list[int] = []
    start = 0
    for at, more in enumerate(joined):
        if not more:
            block = range(start, at + 1)
            fits = [index for index in block if detours[index]]
            places += [index if detours[index] or not fits else fits[0] for index in block]
            start = at + 1
    return places
