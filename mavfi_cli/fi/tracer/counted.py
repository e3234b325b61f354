"""Executions of an instruction are counted: to one stop, by a detour, or over a whole run.

The k-th execution of an instruction is reached by counting. A *detour* counts inside the target, at
a few nanoseconds each. The bytes of the counted instruction are replaced by a jump to a page of
ours. The code there counts down without changing flags or stack, executes the replaced instructions
and jumps back. At zero it stops at a breakpoint instead. Nobody may jump between the replaced
instructions. If they have fewer than five bytes, a short jump leads over five bytes nearby that
nobody executes.

A program that is too long to be stepped is known by its execution counts. Instructions that always
execute together have the same counts. So a hot one is counted at a place among them where a detour
fits: one of them leads to the next, and both are executed equally often.
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

_BY_BREAKPOINT = 100_000  # most executions that are counted by a breakpoint: about a second
_JUMP_BYTES, _SHORT_JUMP_BYTES = 5, 2
_SHORT_JUMP = range(-126, 130)  # where a short jump leads, from its own address
_PAGE = 4096
_SAVED, _COUNTER, _RETURN = 0, 8, 16  # offsets of the data
_FIXED = frozenset(("syscall", "sysenter", "int", "int3", "hlt", "ud2", "xbegin", "xabort", "xend"))


@dataclass(frozen=True, slots=True, kw_only=True)
class _DetourCode:
    """The bytes of a detour."""

    jumps: dict[int, bytes]  # by address, in the code of the program
    pages: dict[int, bytes]  # by address
    stop: int  # the instruction pointer when the count is over


class Counting(Enum):
    """How executions are counted, from the quickest, which changes the most code."""

    FAR_DETOUR = "detour over unused bytes"
    DETOUR = "detour"
    BREAKPOINT = "breakpoint"


@dataclass(frozen=True, slots=True)
class Detour:
    """The place of a detour that counts the executions of an instruction.

    Attributes:
        size: bytes of the whole instructions that the detour replaces; nothing jumps between them.
        via: distance from the instruction to unused bytes that hold a second jump; 0 if one jump
            is enough.
    """

    size: int
    via: int = 0

    @property
    def counting(self) -> Counting:
        """The counting method."""
        return Counting.FAR_DETOUR if self.via else Counting.DETOUR

    @classmethod
    def at(cls, address: int, code_at: CodeAt, executions: Executions) -> Detour | None:
        """The detour at one instruction; None if none fits there."""
        size = _straight_bytes(address, code_at, executions)
        return cls(size) if size >= _JUMP_BYTES else None

    def code(self, code: bytes, address: int, pages: int, count: int) -> _DetourCode | None:
        """Make the detour that stops before execution `count` of the instruction at `address`.

        Args:
            code: the replaced instructions; only the last may be a branch.
            pages: address of two pages of memory, less than 2 GB away.

        Returns:
            None if an instruction cannot be executed elsewhere.
        """
        start = pages + _PAGE  # code beside data that is written would be slow
        parts = [
            _rcx(b"\x89", pages + _SAVED, start),
            _rcx(b"\x8b", pages + _COUNTER, start + 7),
            b"\x48\x8d\x49\xff",  # lea rcx, [rcx-1]
            _rcx(b"\x89", pages + _COUNTER, start + 18),
        ]
        moved = _rcx(b"\x8b", pages + _SAVED, start + 27)
        at = address
        returns_to = address + len(code)
        for found in engine.disasm(code, address):
            piece = _moved(found, start + 27 + len(moved), pages + _RETURN)
            if piece is None:
                return None
            moved += piece
            at = found.address + found.size
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
    """Run until `location` is about to execute for the `count`-th time since the stage before."""

    location: Location
    count: int
    detour: Detour | None = None  # None: the executions are counted by a breakpoint


# -- how control flows


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flow:
    """How control flows through one instruction, and whether it can be executed elsewhere."""

    size: int
    straight: bool  # the next instruction follows, always
    movable: bool
    repeated: bool  # a string instruction that may repeat itself


@functools.lru_cache(maxsize=65536)
def _flow(code: bytes, address: int) -> _Flow | None:
    """How control flows through one instruction; None if the bytes are not an instruction."""
    found = next(engine.disasm(code[:16], address, 1), None)
    if found is None:
        return None
    leaves = not BRANCHES.isdisjoint(found.groups)
    return _Flow(
        size=found.size,
        straight=not leaves and found.mnemonic not in _FIXED,
        movable=_moved(found, address, address) is not None,
        repeated=found.mnemonic.startswith("rep") and not leaves,
    )


def _rcx(opcode: bytes, place: int, at: int) -> bytes:
    """Load rcx from memory or store it there, by an instruction at `at`."""
    return b"\x48" + opcode + b"\x0d" + struct.pack("<i", place - at - 7)


def _jump(target: int, at: int) -> bytes:
    return b"\xe9" + struct.pack("<i", target - at - 5)


def _moved(found: Any, at: int, return_slot: int) -> bytes | None:
    """The instruction as it has to be at another address; None if it cannot be moved."""
    raw = bytes(found.bytes)
    if found.mnemonic in _FIXED:
        return None
    immediate = bool(found.operands) and found.operands[0].type == x86.X86_OP_IMM
    if found.group(x86.X86_GRP_CALL):
        if not immediate:
            return None
        push = b"\xff\x35" + struct.pack("<i", return_slot - at - 6)  # the true return address
        return push + _jump(found.operands[0].imm, at + 6)
    if found.group(x86.X86_GRP_JUMP) and immediate:
        target = found.operands[0].imm
        first, second = found.opcode[0], found.opcode[1]
        if first in (0xE9, 0xEB):
            return _jump(target, at)
        if first >> 4 != 7 and not (first == 0x0F and second >> 4 == 8):
            return None  # loop, jrcxz
        condition = (first if first >> 4 == 7 else second) & 15
        return bytes([0x0F, 0x80 | condition]) + struct.pack("<i", target - at - 6)
    if any(op.type == x86.X86_OP_MEM and op.mem.base == x86.X86_REG_RIP for op in found.operands):
        place = found.disp_offset
        there = found.disp + found.address - at
        if raw[place : place + 4] != struct.pack("<i", found.disp) or abs(there) >> 31:
            return None
        return raw[:place] + struct.pack("<i", there) + raw[place + 4 :]
    return raw


# -- a whole run


@dataclass(frozen=True, kw_only=True, eq=False)
class CountedRun:
    """How often each instruction in scope is executed in one run.

    Attributes:
        addresses: (n,) instructions, ascending.
        counts: (n,) executions of each.
        places: (n,) index of the instruction at which each is counted.
        detours: for each instruction, the detour that counts it; None if none fits.
        joined: for each instruction, whether it always leads to the next, and nothing else does.
    """

    addresses: NDArray[np.int64]
    counts: NDArray[np.int64]
    places: NDArray[np.int64]
    detours: tuple[Detour | None, ...]
    joined: tuple[bool, ...]

    @classmethod
    def of(cls, executions: Mapping[int, int], code_at: CodeAt) -> CountedRun:
        """Make the population from the number of executions of each address."""
        addresses = sorted(executions)
        flows = [_flow(code_at(address), address) for address in addresses]
        counts = _without_repeats(addresses, [executions[each] for each in addresses], flows)
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
        """The same run, of which fewer executions are reached, without some counting methods."""
        detours = [None if each and each.counting in methods else each for each in self.detours]
        places = np.array(_places(detours, self.joined), np.int64)
        return replace(self, detours=tuple(detours), places=places)

    @functools.cached_property
    def reached(self) -> NDArray[np.int64]:
        """(n,) executions of each instruction, from the first, that can be reached."""
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
        """Index and number of the execution, from 1, of one executed instruction."""
        index = int(np.searchsorted(self._ends, position, side="right"))
        return index, position - int(self._ends[index] - self.reached[index]) + 1

    def address(self, position: int) -> int:
        """The address of one executed instruction."""
        return int(self.addresses[self._at(position)[0]])

    def trigger(
        self, position: int, locate: Locate, _: CodeAt
    ) -> tuple[tuple[CountedStop, ...], int]:
        """The trigger of one executed instruction, and k, the number of its execution."""
        index, k = self._at(position)
        return self.stages(index, k, locate), k

    def stages(self, index: int, k: int, locate: Locate) -> tuple[CountedStop, ...]:
        """The stages to execution k of an instruction."""
        place = int(self.places[index])
        here, there = (locate(int(self.addresses[at])) for at in (index, place))
        detour = self.detours[place]
        if place == index:
            return (CountedStop(here, k, detour),)
        before = k if place < index else k - 1  # executions of the place until then
        first = (CountedStop(there, before, detour),) if before else ()
        return (*first, CountedStop(here, 1))


def _straight_bytes(address: int, code_at: CodeAt, executions: Executions) -> int:
    """Bytes of the instructions from one on that a detour can replace, as many as it needs."""
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
    """Count a repeated string instruction once, however often it repeats itself."""
    counts = list(counts)
    for at, how in enumerate(flows):
        if how is None or not how.repeated or at + 1 == len(addresses):
            continue
        if addresses[at + 1] == addresses[at] + how.size:
            counts[at] = min(counts[at], counts[at + 1])
    return counts


def _joined(addresses: list[int], counts: list[int], flows: list[_Flow | None]) -> list[bool]:
    """Whether each instruction always leads to the next, and nothing else does."""
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
    """The detour at each instruction."""
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
    """A detour over the first bytes nearby that nothing executes."""
    for gap in gaps:
        first = max(gap.start, near.start)
        if first >= near.stop:
            return None
        if first in gap:
            return Detour(size, first - address)
    return None


def _places(detours: Sequence[Detour | None], joined: Sequence[bool]) -> list[int]:
    """The index at which each is counted: its own, or the first possible of its block."""
    places: list[int] = []
    start = 0
    for at, more in enumerate(joined):
        if not more:
            block = range(start, at + 1)
            fits = [each for each in block if detours[each]]
            places += [each if detours[each] or not fits else fits[0] for each in block]
            start = at + 1
    return places
