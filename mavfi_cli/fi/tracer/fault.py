"""Instruction-level faults, fully resolved: trigger and corruption, and how they are drawn."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from mavfi_cli.core.errors import BitOutsideWidth, FaultError, named_member
from mavfi_cli.fi import bits
from mavfi_cli.fi.bits import Field
from mavfi_cli.fi.tracer.arch import (
    TRAITS,
    Detour,
    Instruction,
    RegisterUse,
    register_kind,
    width_of,
)
from mavfi_cli.fi.tracer.image import Location


class Site(Enum):
    """The kind of state that a fault corrupts."""

    GENERAL = "general"
    FLAGS = "flags"
    VECTOR = "vector"
    X87 = "x87"
    MASK = "mask"  # AVX-512 opmask
    INSTRUCTION_POINTER = "instruction-pointer"
    OPCODE = "opcode"
    MEMORY = "memory"


DATA_REGISTERS = frozenset((Site.GENERAL, Site.FLAGS, Site.VECTOR, Site.X87, Site.MASK))


class Role(Enum):
    """Whether the corrupted operand is read or written by the instruction."""

    SOURCE = "source"  # corrupted before the instruction executes
    DESTINATION = "destination"  # corrupted after the instruction has written it


@dataclass(frozen=True, slots=True)
class CountedStop:
    """Run until `location` is about to execute for the `count`-th time since the stage before."""

    location: Location
    count: int
    detour: Detour | None = None  # None: the executions are counted by a breakpoint


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionCorruption:
    """The inverted bits, relative to one execution of one instruction."""

    site: Site
    role: Role
    register: str  # the full register; empty for opcode and memory
    operand: str  # as the assembler names it
    bits: tuple[int, ...]  # of the full register, of the opcode bytes, or of the memory operand
    memory_operand: int = 0  # index among the instruction's memory operands
    inverts: str = (
        ""  # a conditional jump: those of `bits` are struck that make it go the other way
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionFault:
    """One fault. The last stage of the trigger is the attacked instruction itself."""

    trigger: tuple[CountedStop, ...]
    execution: int  # k: number of the execution in the profiled scope, from 1
    instruction: str
    instruction_bytes: bytes
    corruption: InstructionCorruption | None  # None: null injection, everything but the flip

    @property
    def target(self) -> Location:
        """The attacked instruction."""
        return self.trigger[-1].location


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultModel:
    """The operands and bits from which a corruption is drawn."""

    sites: frozenset[Site] = DATA_REGISTERS
    roles: frozenset[Role] = frozenset((Role.SOURCE, Role.DESTINATION))
    implicit: bool = True
    field: Field = Field.ANY  # sign, exponent, mantissa: of the elements of float instructions
    count: int = 1

    @classmethod
    def named(
        cls, *, sites: Iterable[str], roles: Iterable[str], field: str, bits: int
    ) -> FaultModel:
        """Make a model from names; no site means the data registers, no role means both.

        Raises:
            UnknownName: a name that does not exist; names the nearest.
        """
        default = cls()
        return cls(
            sites=frozenset(named_member(Site, "site", name) for name in sites) or default.sites,
            roles=frozenset(named_member(Role, "role", name) for name in roles) or default.roles,
            field=named_member(Field, "field", field),
            count=bits,
        )

    def to_json(self) -> dict[str, Any]:
        """The model as plain values, without the peculiarities of compat modes."""
        return {
            "sites": sorted(site.value for site in self.sites),
            "roles": sorted(role.value for role in self.roles),
            "field": self.field.value,
            "bits": self.count,
        }


_Operand = tuple[InstructionCorruption, int]  # a corruption without bits, and those to draw from


def draw_corruption(
    instruction: Instruction, model: FaultModel, rng: np.random.Generator
) -> InstructionCorruption | None:
    """Draw an operand of the instruction uniformly, then distinct bits of it uniformly.

    Returns:
        None if the instruction has no operand that the model allows.
    """
    candidates = [
        (operand, mask)
        for operand, mask in _operands(instruction, model)
        if mask.bit_count() >= model.count
    ]
    if not candidates:
        return None
    operand, mask = candidates[int(rng.integers(len(candidates)))]
    available = bits.bits_of(mask)
    picked = rng.choice(len(available), size=model.count, replace=False)
    return replace(operand, bits=tuple(sorted(available[int(index)] for index in picked)))


def site_of(register: str) -> Site:
    """The site that a full register is."""
    return Site(register_kind(register))


def explicit_corruption(register: str, bit: int, role: Role = Role.SOURCE) -> InstructionCorruption:
    """Make the corruption that the user names.

    Raises:
        FaultError: no such register.
        BitOutsideWidth: the register has no such bit.
    """
    try:
        width = width_of(register)
    except KeyError:
        raise FaultError(f"no register {register!r} on this processor") from None
    if not 0 <= bit < width:
        raise BitOutsideWidth(bit, register, width)
    return InstructionCorruption(
        site=site_of(register), role=role, register=register, operand=register, bits=(bit,)
    )


def _operands(instruction: Instruction, model: FaultModel) -> list[_Operand]:
    found: list[_Operand] = []
    for role, uses in ((Role.SOURCE, instruction.reads), (Role.DESTINATION, instruction.writes)):
        if role in model.roles:
            found += _registers(instruction, model, role, uses)
            found += _memory(instruction, model, role)
    if model.field is Field.ANY:
        found += _control(instruction, model)
    return found


def _operand(
    site: Site, role: Role, mask: int, operand: str, register: str = "", memory_operand: int = 0
) -> _Operand:
    corruption = InstructionCorruption(
        site=site, role=role, register=register, operand=operand, bits=(),
        memory_operand=memory_operand,
    )  # fmt: skip
    return corruption, mask


def _registers(
    instruction: Instruction, model: FaultModel, role: Role, uses: tuple[RegisterUse, ...]
) -> list[_Operand]:
    merged: dict[str, _Operand] = {}
    for use in uses:
        site = site_of(use.register)
        if not (use.mask and site in model.sites and (use.explicit or model.implicit)):
            continue
        mask, name = use.mask & _field_mask(instruction, model, role, site), use.operand
        if use.register in merged:  # the flags of one instruction are one operand
            mask, name = mask | merged[use.register][1], use.register
        merged[use.register] = _operand(site, role, mask, name, use.register)
    return [operand for operand in merged.values() if operand[1]]


def _field_mask(instruction: Instruction, model: FaultModel, role: Role, site: Site) -> int:
    if model.field is Field.ANY:
        return -1
    element = instruction.elements[role is Role.DESTINATION]
    if site is not Site.VECTOR or element is None:
        return 0
    kind = bits.NUMPY_TYPES[element]
    lane = bits.mask_of(kind.field_bits(model.field), kind)
    if instruction.scalar:
        return lane
    return sum(lane << shift for shift in range(0, TRAITS.vector_bits, kind.width))


def _memory(instruction: Instruction, model: FaultModel, role: Role) -> list[_Operand]:
    if Site.MEMORY not in model.sites or model.field is not Field.ANY:
        return []
    return [
        _operand(Site.MEMORY, role, use.mask, use.operand, memory_operand=index)
        for index, use in enumerate(instruction.memory)
        if (use.reads if role is Role.SOURCE else use.writes)
    ]


def _control(instruction: Instruction, model: FaultModel) -> list[_Operand]:
    found = []
    if Site.INSTRUCTION_POINTER in model.sites:
        pointer = TRAITS.instruction_pointer
        mask = (1 << width_of(pointer)) - 1
        site = Site.INSTRUCTION_POINTER
        found.append(_operand(site, Role.DESTINATION, mask, pointer, pointer))
    if Site.OPCODE in model.sites:
        mask = (1 << 8 * len(instruction.raw)) - 1
        found.append(_operand(Site.OPCODE, Role.SOURCE, mask, "opcode"))
    return found
