"""Rules of other injectors, imitated so that published numbers can be compared.

A rule draws the corruption of one instruction, or None if that injector leaves it alone. The
released sources are the reference: ROSFI as in MAVBench/MAV_apps, branch mavfi, and PINFI as in
DependableSystemsLab/pinfi, e14c129. docs/reference/instructions.md says what they do and where we
differ.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from mavfi_cli.fi import bits
from mavfi_cli.fi.tracer.arch import JUMP_FLAGS, TRAITS, Instruction, RegisterUse
from mavfi_cli.fi.tracer.fault import (
    FaultModel,
    InstructionCorruption,
    Role,
    Site,
    draw_corruption,
    site_of,
)

ROSFI_MODEL = FaultModel(sites=frozenset((Site.GENERAL, Site.VECTOR)))
# ROSFI refuses these registers, so that r8 to r13 and XMM get nearly all faults (regManip.cpp,
# rosfi.cpp).
_ROSFI_REFUSED = frozenset(
    "rip rax rbx rcx rdx rsi rdi rbp rsp r14 r15 esi edi eax ecx edx bl cl dl".split()  # noqa: SIM905
)
PINFI_MODEL = FaultModel(roles=frozenset((Role.DESTINATION,)))
_FLAGS_WIDTH = 64
_VECTOR = re.compile(r"([xyz])mm\d*(\d)$")


def draw_rosfi(
    instruction: Instruction, _following: Instruction | None, rng: np.random.Generator
) -> InstructionCorruption | None:
    """ROSFI: moves bits 52 to 62 (110 to 126 of XMM) to byte 0, and refuses most registers."""
    drawn = draw_corruption(instruction, ROSFI_MODEL, rng)
    if drawn is None or drawn.operand in _ROSFI_REFUSED:
        return None
    wide = drawn.site is Site.VECTOR
    bit = int(rng.integers(110, 127) if wide else rng.integers(52, 63))
    return replace(drawn, bits=(bit % 8,))


def draw_pinfi(
    instruction: Instruction, following: Instruction | None, rng: np.random.Generator
) -> InstructionCorruption | None:
    """PINFI: one bit of a register that the instruction writes, after it has executed.

    The flags are struck only where no other register is written: to invert the conditional jump
    that follows, or else as 64 bits, most of which are no flag and change nothing. Without such a
    jump, an instruction that also writes memory has a bit of its memory operand struck before it
    executes.
    """
    written = [use for use in instruction.writes if use.mask]
    if instruction.branches or not written:
        return None
    registers = [use for use in written if site_of(use.register) is not Site.FLAGS]
    if registers:
        return _register_bit(registers[int(rng.integers(len(registers)))], rng)
    if following is not None and following.mnemonic in JUMP_FLAGS:
        return _inverted_jump(following.mnemonic)
    for index, use in enumerate(instruction.memory):
        if use.writes:
            bit = int(rng.integers(8 * use.size))
            return InstructionCorruption(
                site=Site.MEMORY, role=Role.SOURCE, register="", operand=use.operand,
                bits=(bit,), memory_operand=index,
            )  # fmt: skip
    bit = int(rng.integers(_FLAGS_WIDTH))
    return _flags((bit,) if bit in bits.bits_of(TRAITS.flags) else ())


def draw_pinfi_with_bugs(
    instruction: Instruction, following: Instruction | None, rng: np.random.Generator
) -> InstructionCorruption | None:
    """PINFI with its bugs: it numbers a vector register by the last digit of its name.

    So xmm10 to xmm15 are taken for xmm0 to xmm5. A bit of a YMM register is sought in its upper
    half.
    """
    drawn = draw_pinfi(instruction, following, rng)
    if drawn is None or (match := _VECTOR.match(drawn.operand)) is None:
        return drawn
    upper = tuple(128 + bit for bit in drawn.bits) if match[1] == "y" else drawn.bits
    return replace(drawn, register=f"{drawn.register[:3]}{match[2]}", bits=upper)


def _register_bit(use: RegisterUse, rng: np.random.Generator) -> InstructionCorruption:
    site = site_of(use.register)
    available = range(64) if site is Site.VECTOR else bits.bits_of(use.mask)
    bit = int(available[int(rng.integers(len(available)))])
    return InstructionCorruption(
        site=site, role=Role.DESTINATION, register=use.register, operand=use.operand, bits=(bit,)
    )


def _inverted_jump(jump: str) -> InstructionCorruption:
    tested = JUMP_FLAGS[jump]
    return replace(_flags(tested), inverts=jump if len(tested) > 1 else "")


def _flags(struck: tuple[int, ...]) -> InstructionCorruption:
    name = TRAITS.flags_register
    return InstructionCorruption(
        site=Site.FLAGS, role=Role.DESTINATION, register=name, operand=name, bits=struck
    )
