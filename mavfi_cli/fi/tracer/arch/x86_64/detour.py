"""A detour that counts executions inside the target, at a few nanoseconds each.

The bytes of the counted instruction are replaced by a jump to a page of ours. The code there counts
down without changing flags or stack, executes the replaced instructions and jumps back. At zero it
stops at a breakpoint instead. Nobody may jump between the replaced instructions. If they have fewer
than five bytes, a short jump leads over five bytes nearby that nobody executes.
"""

from __future__ import annotations

import functools
import struct
from dataclasses import dataclass
from typing import Any

from capstone import x86

from mavfi_cli.fi.tracer.arch.interface import Flow
from mavfi_cli.fi.tracer.arch.x86_64.decode import branches, engine
from mavfi_cli.fi.tracer.arch.x86_64.registers import TRAITS

_PAGE = 4096
_SAVED, _COUNTER, _RETURN = 0, 8, 16  # offsets of the data
_FIXED = frozenset(("syscall", "sysenter", "int", "int3", "hlt", "ud2", "xbegin", "xabort", "xend"))


@dataclass(frozen=True, slots=True, kw_only=True)
class _DetourCode:
    """The bytes of a detour."""

    jumps: dict[int, bytes]  # by address, in the code of the program
    pages: dict[int, bytes]  # by address
    stop: int  # the instruction pointer when the count is over


@functools.lru_cache(maxsize=65536)
def flow(code: bytes, address: int) -> Flow | None:
    """How control flows through one instruction; None if the bytes are not an instruction."""
    found = next(engine.disasm(code[:16], address, 1), None)
    if found is None:
        return None
    leaves = branches(found)
    return Flow(
        size=found.size,
        straight=not leaves and found.mnemonic not in _FIXED,
        movable=_moved(found, address, address) is not None,
        repeated=found.mnemonic.startswith("rep") and not leaves,
    )


def detour_code(code: bytes, address: int, pages: int, count: int, via: int) -> _DetourCode | None:
    """Make the detour that stops before execution `count` of the instruction at `address`.

    Args:
        code: the replaced instructions; only the last may be a branch.
        pages: address of two pages of memory, less than 2 GB away.
        via: where there is room for the jump, from the address; 0: in the code itself.

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
    jumps = {address + via: _jump(start, address + via)}
    if via:
        jumps[address] = b"\xeb" + struct.pack("<b", via - TRAITS.short_jump_bytes)
    return _DetourCode(
        jumps=jumps,
        pages={pages: struct.pack("<QQQ", 0, count, returns_to), start: b"".join(parts)},
        stop=stop + 8,
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
