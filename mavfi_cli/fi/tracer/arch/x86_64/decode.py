"""Decoder of x86-64 instructions to the register bits and memory bytes that they read and write.

Capstone decodes, `operands` says which bits count. This module adds the stack slots of push, pop,
call and ret, and what the tracer has to know of an instruction to step over it.
"""

from __future__ import annotations

import functools
import re
from typing import Any

import capstone
from capstone import x86

from mavfi_cli.fi.tracer.arch.interface import Instruction, MemoryUse
from mavfi_cli.fi.tracer.arch.x86_64.jumps import branches
from mavfi_cli.fi.tracer.arch.x86_64.operands import Operands, general_part, operands_of

_FULL = (1 << 64) - 1

_engine: Any = capstone.Cs(capstone.CS_ARCH_X86, capstone.CS_MODE_64)
_engine.detail = True


def decode(code: bytes, address: int) -> Instruction | None:
    """Decode one instruction from 16 bytes; None if the bytes are not an instruction."""
    return _decode(bytes(code[:16]), address)


@functools.lru_cache(maxsize=65536)
def _decode(code: bytes, address: int) -> Instruction | None:
    found = next(_engine.disasm(code, address, 1), None)
    if found is None:
        return None
    operands = operands_of(found)
    return Instruction(
        address=address,
        raw=code[: found.size],
        mnemonic=found.mnemonic,
        text=f"{found.mnemonic} {found.op_str}".strip(),
        reads=tuple(operands.reads.values()),
        writes=tuple(operands.writes.values()),
        memory=(*_memory(found, operands), *_stack(found)),
        elements=_elements(found.mnemonic),
        scalar=found.mnemonic.endswith(("sd", "ss")) and "broadcast" not in found.mnemonic,
        branches=branches(found),
        run_over=_run_over(found),
    )


def _run_over(found: Any) -> bool:
    """True if one single step is not enough, or leaves a trace.

    A step executes one iteration of a repeated string instruction. `rep ret` is a plain return.
    After a step over a pop of the flags, Linux takes the trap flag for the program's own
    (`enable_single_step` in arch/x86/kernel/step.c), and would leave it set.
    """
    repeated = found.mnemonic.startswith("rep") and not branches(found)
    return repeated or found.mnemonic in ("popfq", "popf")


_FLOATS = {"sd": "float64", "pd": "float64", "ss": "float32", "ps": "float32"}
_CONVERSION = re.compile(r"v?cvtt?(\w+)2(\w+)$")
_INTEGERS = re.compile(r"v?p\w*s[ds]$")  # of signed doublewords: pmaxsd, pabsd


def _elements(mnemonic: str) -> tuple[str | None, str | None]:
    """The floats that an instruction reads and writes."""
    if match := _CONVERSION.match(mnemonic):
        return _FLOATS.get(match[1]), _FLOATS.get(match[2])
    element = None if _INTEGERS.match(mnemonic) else _FLOATS.get(mnemonic[-2:])
    return element, element


def _memory(found: Any, operands: Operands) -> list[MemoryUse]:
    if found.mnemonic == "lea":
        return []

    def name(number: int) -> str | None:
        return str(found.reg_name(number)) if number else None

    return [
        MemoryUse(
            base=name(op.mem.base),
            index=name(op.mem.index),
            scale=op.mem.scale,
            displacement=op.mem.disp,
            segment=name(op.mem.segment),
            size=(mask.bit_length() + 7) // 8,
            mask=mask,
            reads=bool(bits.reads),
            writes=bool(bits.writes),
        )
        for op, bits in zip(found.operands, operands.explicit, strict=True)
        if op.type == x86.X86_OP_MEM and (mask := bits.reads | bits.writes)
    ]


def _stack(found: Any) -> list[MemoryUse]:
    mnemonic = found.mnemonic.split()[-1]  # without rep, bnd or notrack
    if mnemonic.startswith(("push", "call")):
        displacement, reads = -8, False
    elif mnemonic.startswith(("pop", "ret", "leave")) and not mnemonic.startswith("popcnt"):
        displacement, reads = 0, True
    else:
        return []
    return [
        MemoryUse(
            base="rbp" if mnemonic == "leave" else "rsp",
            index=None,
            scale=1,
            displacement=displacement,
            segment=None,
            size=8,
            mask=_FULL,
            reads=reads,
            writes=not reads,
        )
    ]


def address_of(use: MemoryUse, instruction: Instruction, read: Any) -> int:
    """Address of a memory operand before the instruction executes.

    Args:
        read: function that returns the value of a full register.
    """
    total = use.displacement
    if use.base == "rip":
        total += instruction.next_address
    else:
        total += _part(use.base, read)
    total += _part(use.index, read) * use.scale
    if use.segment in ("fs", "gs"):
        total += read(f"{use.segment}_base")
    return int(total & _FULL)


def _part(name: str | None, read: Any) -> int:
    part = general_part(name) if name else None
    if part is None:
        return 0
    full, mask = part
    return int(read(full)) & mask
