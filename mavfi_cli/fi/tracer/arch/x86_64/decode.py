"""Decoder of x86-64 instructions to the register bits and memory bytes that they read and write.

Capstone names the explicit and implicit registers. This module adds what it does not say: which
bits of the full register an operand covers (a 32-bit write clears the upper half, a VEX-encoded
one the whole rest; Intel SDM volume 1, sections 3.4.1.1 and 14.1.1), the stack slots of push,
pop, call and ret, the x87 stack top, and the registers of a Linux system call.
"""

from __future__ import annotations

import functools
import re
from typing import Any

import capstone
from capstone import x86

from mavfi_cli.fi.tracer.arch.interface import Instruction, MemoryUse, RegisterUse
from mavfi_cli.fi.tracer.arch.x86_64.registers import (
    AVX,
    FLAG_BITS,
    GENERAL,
    ZMM_HIGH,
    xsave_components,
)

_FULL = (1 << 64) - 1


@functools.lru_cache(maxsize=1)
def widest_vector() -> str:
    """The name of the full vector registers of this processor."""
    components = xsave_components()
    return "zmm" if ZMM_HIGH in components else "ymm" if AVX in components else "xmm"


def _sub_registers() -> dict[str, tuple[str, int]]:
    """Name -> (full register, mask) of every general-purpose register name."""
    table = {name: (name, _FULL) for name in GENERAL}
    for letter in "abcd":
        full = f"r{letter}x"
        table |= {f"e{letter}x": (full, 0xFFFF_FFFF), f"{letter}x": (full, 0xFFFF)}
        table |= {f"{letter}l": (full, 0xFF), f"{letter}h": (full, 0xFF00)}
    for pair in ("si", "di", "bp", "sp"):
        full = f"r{pair}"
        table |= {f"e{pair}": (full, 0xFFFF_FFFF), pair: (full, 0xFFFF), f"{pair}l": (full, 0xFF)}
    for number in range(8, 16):
        full = f"r{number}"
        table |= {f"{full}d": (full, 0xFFFF_FFFF), f"{full}w": (full, 0xFFFF)}
        table |= {f"{full}b": (full, 0xFF)}
    return table


_GENERAL = _sub_registers()
_VECTOR = re.compile(r"([xyz])mm(\d+)$")
_X87 = re.compile(r"st\((\d)\)$")
_FLAG_TESTS = {name: getattr(x86, f"X86_EFLAGS_TEST_{name.upper()}") for name in FLAG_BITS}
_FLAG_WRITES = {
    name: sum(
        getattr(x86, f"X86_EFLAGS_{how}_{name.upper()}", 0)
        for how in ("MODIFY", "RESET", "SET", "UNDEFINED")
    )
    | (x86.X86_EFLAGS_RESET_0F if name == "of" else 0)
    for name in FLAG_BITS
}
_ZEROING = re.compile(r"v?p?(xor|sub)([bwdq]|p[sd])?$|v?xorp[sd]$|vpxor[dq]$")
_NO_ACCESS = ("lea", "nop", "prefetch")
_BRANCHES = {x86.X86_GRP_JUMP, x86.X86_GRP_CALL, x86.X86_GRP_RET, x86.X86_GRP_IRET}
_CALL_READS = ("rax", "rdi", "rsi", "rdx", "r10", "r8", "r9")

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
    vex = code[0] in (0xC4, 0xC5, 0x62)
    explicit = {found.reg_name(op.reg) for op in found.operands if op.type == x86.X86_OP_REG}
    read_ids, written_ids = found.regs_access()
    reads = [_use(found, found.reg_name(r), explicit, vex) for r in read_ids]
    writes = [_use(found, found.reg_name(r), explicit, vex) for r in written_ids]
    names = [found.reg_name(op.reg) for op in found.operands if op.type == x86.X86_OP_REG]
    if _ZEROING.match(found.mnemonic) and len(names) > 1 and len(set(names)) == 1:
        reads = []
    reads += _flags(found, _FLAG_TESTS)
    writes += _flags(found, _FLAG_WRITES)
    _add_hidden(found, reads, writes)
    return Instruction(
        address=address,
        raw=code[: found.size],
        mnemonic=found.mnemonic,
        text=f"{found.mnemonic} {found.op_str}".strip(),
        reads=tuple(use for use in reads if use is not None),
        writes=tuple(use for use in writes if use is not None),
        memory=(*_memory(found), *_stack(found)),
        element=_element(found.mnemonic),
        scalar=found.mnemonic.endswith(("sd", "ss")),
        branches=bool(_BRANCHES.intersection(found.groups)),
        run_over=_run_over(found.mnemonic),
    )


def _run_over(mnemonic: str) -> bool:
    """True if one single step is not enough, or leaves a trace.

    A step executes one iteration of a repeated string instruction. After a step over a pop of the
    flags, Linux takes the trap flag for the program's own (`enable_single_step` in
    arch/x86/kernel/step.c), and would leave it set.
    """
    return mnemonic.startswith("rep") or mnemonic in ("popfq", "popf")


def _element(mnemonic: str) -> str | None:
    if mnemonic.startswith(("mov", "vmov")) and mnemonic.endswith(("dqa", "dqu")):
        return None
    if mnemonic.endswith(("sd", "pd")):
        return "float64"
    return "float32" if mnemonic.endswith(("ss", "ps")) else None


def _use(found: Any, name: str, explicit: set[str], vex: bool) -> RegisterUse | None:
    if name in _GENERAL:
        register, mask = _GENERAL[name]
        clears = _FULL if mask == 0xFFFF_FFFF else mask
    elif match := _VECTOR.match(name):
        register = f"{widest_vector()}{match[2]}"
        mask = (1 << {"x": 128, "y": 256, "z": 512}[match[1]]) - 1
        clears = (1 << 512) - 1 if vex else _legacy_cover(found)
    elif match := _X87.match(name):
        register, mask = f"st{match[1]}", (1 << 80) - 1
        clears = mask
    elif re.match(r"(k|mm)\d$", name):
        register, mask = name, _FULL
        clears = mask
    else:
        return None  # flags are named bit by bit; segments and control words are not targets
    if found.mnemonic.startswith("cmov"):
        clears = 0  # it may not write
    return RegisterUse(
        register=register, mask=mask, clears=clears, explicit=name in explicit, operand=name
    )


def _legacy_cover(found: Any) -> int:
    """Bits that a legacy SSE write replaces: scalar forms keep the rest of the register."""
    mnemonic = found.mnemonic
    scalar = mnemonic.endswith(("sd", "ss")) and not mnemonic.startswith("punpck")
    loads = mnemonic in ("movsd", "movss") and any(
        op.type == x86.X86_OP_MEM for op in found.operands
    )
    if scalar and not loads:
        return (1 << (64 if mnemonic.endswith("sd") else 32)) - 1
    return (1 << 128) - 1


def _flags(found: Any, table: dict[str, int]) -> list[RegisterUse | None]:
    if x86.X86_GRP_FPU in found.groups:
        return []
    # Capstone takes the scalar SSE `movsd` for the string instruction of the same name.
    vector = any(_VECTOR.match(found.reg_name(r)) for ids in found.regs_access() for r in ids)
    return [
        RegisterUse(
            register="rflags",
            mask=1 << FLAG_BITS[name],
            clears=1 << FLAG_BITS[name],
            explicit=False,
            operand=name,
        )
        for name, test in table.items()
        if found.eflags & test and not (name == "df" and vector)
    ]


def _hidden(register: str, width: int) -> RegisterUse:
    mask = (1 << width) - 1
    return RegisterUse(register=register, mask=mask, clears=mask, explicit=False, operand=register)


def _add_hidden(
    found: Any, reads: list[RegisterUse | None], writes: list[RegisterUse | None]
) -> None:
    if found.mnemonic == "syscall":
        reads += [_hidden(name, 64) for name in _CALL_READS]
        writes += [_hidden(name, 64) for name in ("rax", "rcx", "r11")]
    elif x86.X86_GRP_FPU in found.groups:
        pushes = found.mnemonic.startswith(("fld", "fild", "fbld"))
        if not pushes:
            reads.append(_hidden("st0", 80))
        if not found.mnemonic.startswith(("fst", "fist", "fcom", "fucom", "ftst", "fxam")):
            writes.append(_hidden("st0", 80))


def _memory(found: Any) -> list[MemoryUse]:
    if found.mnemonic.startswith(_NO_ACCESS):
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
            size=op.size,
            reads=bool(op.access & capstone.CS_AC_READ),
            writes=bool(op.access & capstone.CS_AC_WRITE),
        )
        for op in found.operands
        if op.type == x86.X86_OP_MEM
    ]


def _stack(found: Any) -> list[MemoryUse]:
    mnemonic = found.mnemonic
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
    elif use.base in _GENERAL:
        total += _part(use.base, read)
    if use.index in _GENERAL:
        total += _part(use.index, read) * use.scale
    if use.segment in ("fs", "gs"):
        total += read(f"{use.segment}_base")
    return int(total & _FULL)


def _part(name: str, read: Any) -> int:
    full, mask = _GENERAL[name]
    return int(read(full)) & mask
