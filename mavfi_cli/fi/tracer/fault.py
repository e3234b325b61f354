"""Instruction-level faults, fully resolved, and the strategies by which they are drawn.

Every result names its strategy: a sampling rule with a fault model, or an emulated injector, for
comparison with published numbers. The released sources are the reference: ROSFI as
in MAVBench/MAV_apps, branch mavfi, and PINFI as in DependableSystemsLab/pinfi, e14c129.
docs/reference/instructions.md describes both and how our emulations deviate from them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from enum import Enum

import numpy as np

from mavfi_cli.core.errors import FaultSpecError, UnknownName, named_member
from mavfi_cli.core.files import Json
from mavfi_cli.fi import bits
from mavfi_cli.fi.bits import Field
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.decode import FLAG_BITS, Instruction, RegisterUse
from mavfi_cli.fi.tracer.image import Location
from mavfi_cli.fi.tracer.registers import FLAGS, VECTOR_BITS, width_of


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
    """Whether the instruction reads or writes the corrupted operand."""

    SOURCE = "source"  # corrupted before the instruction executes
    DESTINATION = "destination"  # corrupted after the instruction has written it


# The flags whose flip inverts a jump (Intel SDM volume 2, Jcc).
JUMP_FLAGS = {
    jump: tuple(FLAG_BITS[flag] for flag in flags.split())
    for jumps, flags in (
        ("jo jno", "of"), ("js jns", "sf"), ("jp jnp", "pf"), ("je jne", "zf"), ("jb jae", "cf"),
        ("jl jge", "sf"), ("jbe ja", "cf zf"), ("jle jg", "zf sf"),
    )
    for jump in jumps.split()
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionCorruption:
    """The bits to invert at one execution of one instruction."""

    site: Site
    role: Role
    register: str = ""  # the full register; empty for opcode and memory
    operand: str  # as the assembler names it
    bits: tuple[int, ...] = ()  # bits of the full register, opcode bytes or memory operand
    memory_operand: int = 0  # index among the instruction's memory operands
    inverts: str = ""  # a conditional jump: flip only the bits that invert its decision

    def struck(self, flags: int) -> tuple[int, ...]:
        """Return the bits to invert. The flags register, `flags`, matters only to invert a jump.

        Such a jump tests two conditions: "below" or "less", and "equal". Each one that holds is
        negated. If neither holds, "equal" is made to hold.
        """
        if not self.inverts:
            return self.bits
        carry, zero, sign, overflow = (FLAG_BITS[flag] for flag in ("cf", "zf", "sf", "of"))
        less = carry if carry in self.bits else sign
        below = flags >> less & 1 if less == carry else (flags >> sign ^ flags >> overflow) & 1
        equal = flags >> zero & 1
        if not (below or equal):
            return (zero,)
        return tuple(sorted([less] * below + [zero] * equal))

    def to_json(self) -> Json:
        """Return the corruption as an entry of a record."""
        names = {"site": self.site.value, "role": self.role.value, "bits": list(self.bits)}
        values = asdict(self) | names
        return values if self.inverts else {k: v for k, v in values.items() if k != "inverts"}


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionFault:
    """One instruction-level fault. Its trigger's last stage stops at the attacked instruction."""

    trigger: tuple[CountedStop, ...]
    execution: int  # k: number of the execution in the profiled scope, from 1
    instruction: str
    instruction_bytes: bytes
    corruption: InstructionCorruption | None  # None: a null run, which leaves out the flip

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
    field: Field = Field.ANY  # sign, exponent, mantissa: only in elements of float instructions
    count: int = 1

    @classmethod
    def named(
        cls, *, sites: Iterable[str], roles: Iterable[str], field: str, bits: int
    ) -> FaultModel:
        """Create a model from the names of sites and roles, a field and a number of bits.

        Empty `sites` stand for all data registers, and empty `roles` for both roles.

        Raises:
            UnknownName: a site, role or field does not exist; the message suggests the nearest.
        """
        default = cls()
        return cls(
            sites=frozenset(named_member(Site, "site", name) for name in sites) or default.sites,
            roles=frozenset(named_member(Role, "role", name) for name in roles) or default.roles,
            field=named_member(Field, "field", field),
            count=bits,
        )

    def to_json(self) -> Json:
        """Return the model as plain values, without `implicit`, which no option sets."""
        return {
            "sites": sorted(site.value for site in self.sites),
            "roles": sorted(role.value for role in self.roles),
            "field": self.field.value,
            "bits": self.count,
        }


_Operand = tuple[InstructionCorruption, int]  # a corruption without bits, and the bits to draw from


def _draw_corruption(
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


def _operands(instruction: Instruction, model: FaultModel) -> list[_Operand]:
    operands: list[_Operand] = []
    for role, uses in ((Role.SOURCE, instruction.reads), (Role.DESTINATION, instruction.writes)):
        if role in model.roles:
            operands += _registers(instruction, model, role, uses)
            operands += _memory(instruction, model, role)
    if model.field is Field.ANY:
        operands += _control(instruction, model)
    return operands


def _registers(
    instruction: Instruction, model: FaultModel, role: Role, uses: tuple[RegisterUse, ...]
) -> list[_Operand]:
    merged: dict[str, _Operand] = {}
    for use in uses:
        site = _site_of(use.register)
        if not (use.mask and site in model.sites and (use.explicit or model.implicit)):
            continue
        mask, name = use.mask & _field_mask(instruction, model, role, site), use.operand
        if use.register in merged:  # the flags of one instruction are one operand
            mask, name = mask | merged[use.register][1], use.register
        corruption = InstructionCorruption(
            site=site, role=role, register=use.register, operand=name
        )
        merged[use.register] = corruption, mask
    return [operand for operand in merged.values() if operand[1]]


def _field_mask(instruction: Instruction, model: FaultModel, role: Role, site: Site) -> int:
    if model.field is Field.ANY:
        return -1
    element = instruction.elements[role is Role.DESTINATION]
    if site is not Site.VECTOR or element is None:
        return 0
    kind = bits.NUMPY_TYPES[element]
    lane = kind.mask(kind.field_bits(model.field))
    if instruction.scalar:
        return lane
    return sum(lane << shift for shift in range(0, VECTOR_BITS, kind.width))


def _memory(instruction: Instruction, model: FaultModel, role: Role) -> list[_Operand]:
    if Site.MEMORY not in model.sites or model.field is not Field.ANY:
        return []
    template = InstructionCorruption(site=Site.MEMORY, role=role, operand="")
    return [
        (replace(template, operand=use.operand, memory_operand=index), use.mask)
        for index, use in enumerate(instruction.memory)
        if (use.reads if role is Role.SOURCE else use.writes)
    ]


def _control(instruction: Instruction, model: FaultModel) -> list[_Operand]:
    operands = []
    if Site.INSTRUCTION_POINTER in model.sites:
        mask = (1 << width_of("rip")) - 1
        pointer = InstructionCorruption(
            site=Site.INSTRUCTION_POINTER, role=Role.DESTINATION, register="rip", operand="rip"
        )
        operands.append((pointer, mask))
    if Site.OPCODE in model.sites:
        mask = (1 << 8 * len(instruction.raw)) - 1
        opcode = InstructionCorruption(site=Site.OPCODE, role=Role.SOURCE, operand="opcode")
        operands.append((opcode, mask))
    return operands


def _site_of(register: str) -> Site:
    """Return the site to which a full register belongs."""
    return _SITES.get(register.rstrip("0123456789"), Site.GENERAL)


_SITES = {
    "rflags": Site.FLAGS, "rip": Site.INSTRUCTION_POINTER, "st": Site.X87, "mm": Site.X87,
    "k": Site.MASK, **dict.fromkeys(("xmm", "ymm", "zmm"), Site.VECTOR),
}  # fmt: skip


# -- strategies


Draw = Callable[
    [Instruction, Instruction | None, np.random.Generator], InstructionCorruption | None
]


class Rule(Enum):
    """A rule by which the time of a fault is drawn."""

    INSTRUCTION = "instruction-uniform"  # every executed instruction in scope is equally likely
    CPU_TIME = "cpu-time"  # uniform over the CPU time of the fault-free run
    WALL_CLOCK = "wall-clock"  # uniform over the wall-clock time of the fault-free run


@dataclass(frozen=True, slots=True, kw_only=True)
class Strategy:
    """A sampling rule with a fault model, or an emulation of another injector."""

    name: str
    rule: Rule
    model: FaultModel
    imitates: Draw | None = None  # draws as another injector does, not from the model
    attempts: int = 1  # time rules: maximum number of attempts
    retry_s: float = 0.0  # time rules: delay between attempts
    whole_process: bool = False  # also hits code out of scope
    in_system_calls: bool = False  # also hits a thread that waits in the operating system

    @classmethod
    def of(
        cls, name: str, model: FaultModel | None = None, *, compat: str | None = None
    ) -> Strategy:
        """Return the strategy of a sampling rule or of an emulated injector.

        Raises:
            UnknownName: the rule or compatibility mode does not exist; the message suggests the
                nearest.
            FaultSpecError: a model is given for an emulated injector, which has its own.
        """
        if compat is not None:
            if compat not in COMPAT:
                raise UnknownName("compatibility mode", compat, COMPAT)
            if model not in (None, FaultModel()):
                raise FaultSpecError(
                    f"{compat} cannot be combined with sites, roles, field or bits: it has its own"
                )
            return COMPAT[compat]
        rule = named_member(Rule, "sampling rule", name)
        return cls(name=rule.value, rule=rule, model=model or FaultModel())

    def draw_at(
        self,
        instruction: Instruction,
        rng: np.random.Generator,
        following: Instruction | None = None,
    ) -> InstructionCorruption | None:
        """Draw a corruption of `instruction`, or return None if it has no suitable operand.

        `following` is the instruction after it, which some emulated injectors consider.
        """
        if self.imitates is not None:
            return self.imitates(instruction, following, rng)
        return _draw_corruption(instruction, self.model, rng)


# -- other injectors

_ROSFI_MODEL = FaultModel(sites=frozenset((Site.GENERAL, Site.VECTOR)))
# ROSFI refuses these registers, so r8 to r13 and the XMM registers get nearly all faults
# (regManip.cpp, rosfi.cpp).
_ROSFI_REFUSED = frozenset(
    "rip rax rbx rcx rdx rsi rdi rbp rsp r14 r15 esi edi eax ecx edx bl cl dl".split()  # noqa: SIM905
)
_PINFI_MODEL = FaultModel(roles=frozenset((Role.DESTINATION,)))
_FLAGS_WIDTH = 64
_VECTOR = re.compile(r"([xyz])mm\d*(\d)$")


def _draw_rosfi(
    instruction: Instruction, _following: Instruction | None, rng: np.random.Generator
) -> InstructionCorruption | None:
    """Draw as ROSFI does: refuse most registers, and flip a bit of the lowest byte only.

    It draws a bit n from 52 to 62 (110 to 126 in an XMM register), but flips bit n % 8 instead.
    """
    drawn = _draw_corruption(instruction, _ROSFI_MODEL, rng)
    if drawn is None or drawn.operand in _ROSFI_REFUSED:
        return None
    wide = drawn.site is Site.VECTOR
    bit = int(rng.integers(110, 127) if wide else rng.integers(52, 63))
    return replace(drawn, bits=(bit % 8,))


def _draw_pinfi(
    instruction: Instruction, following: Instruction | None, rng: np.random.Generator
) -> InstructionCorruption | None:
    """Draw as PINFI does: one bit of a register that the instruction writes, after it executes.

    If only flags are written, the conditional jump that follows is inverted. Without such a jump,
    a bit of a memory operand that the instruction also writes is flipped before the instruction
    executes. If it writes no memory, one of 64 bits of the flags register is drawn. Most of these
    are not flags, and drawing one changes nothing.
    """
    written = [use for use in instruction.writes if use.mask]
    if instruction.branches or not written:
        return None
    registers = [use for use in written if _site_of(use.register) is not Site.FLAGS]
    if registers:
        return _register_bit(registers[int(rng.integers(len(registers)))], rng)
    if following is not None and following.mnemonic in JUMP_FLAGS:
        return _inverted_jump(following.mnemonic)
    for index, use in enumerate(instruction.memory):
        if use.writes:
            bit = int(rng.integers(8 * use.size))
            return InstructionCorruption(
                site=Site.MEMORY, role=Role.SOURCE, operand=use.operand, bits=(bit,),
                memory_operand=index,
            )  # fmt: skip
    bit = int(rng.integers(_FLAGS_WIDTH))
    return _flags((bit,) if bit in bits.bits_of(FLAGS) else ())


def _draw_pinfi_with_bugs(
    instruction: Instruction, following: Instruction | None, rng: np.random.Generator
) -> InstructionCorruption | None:
    """Draw as PINFI does, including its bugs.

    It reads only the last digit of a vector register's name, so it mistakes xmm10 to xmm15 for xmm0
    to xmm5. In a YMM register, it flips bits of the upper half only.
    """
    drawn = _draw_pinfi(instruction, following, rng)
    if drawn is None or (match := _VECTOR.match(drawn.operand)) is None:
        return drawn
    upper = tuple(128 + bit for bit in drawn.bits) if match[1] == "y" else drawn.bits
    return replace(drawn, register=f"{drawn.register[:3]}{match[2]}", bits=upper)


def _register_bit(use: RegisterUse, rng: np.random.Generator) -> InstructionCorruption:
    site = _site_of(use.register)
    available = range(64) if site is Site.VECTOR else bits.bits_of(use.mask)
    bit = int(available[int(rng.integers(len(available)))])
    return InstructionCorruption(
        site=site, role=Role.DESTINATION, register=use.register, operand=use.operand, bits=(bit,)
    )


def _inverted_jump(jump: str) -> InstructionCorruption:
    tested = JUMP_FLAGS[jump]
    return replace(_flags(tested), inverts=jump if len(tested) > 1 else "")


def _flags(struck: tuple[int, ...]) -> InstructionCorruption:
    name = "rflags"
    return InstructionCorruption(
        site=Site.FLAGS, role=Role.DESTINATION, register=name, operand=name, bits=struck
    )


COMPAT = {
    "rosfi-2021": Strategy(
        name="rosfi-2021 (wall-clock, low byte only, most registers refused)",
        rule=Rule.WALL_CLOCK,
        model=_ROSFI_MODEL,
        imitates=_draw_rosfi,
        attempts=100,
        retry_s=500e-6,
        whole_process=True,
        in_system_calls=True,
    ),
    "pinfi": Strategy(
        name="pinfi (instruction-uniform, one register that is written)",
        rule=Rule.INSTRUCTION,
        model=_PINFI_MODEL,
        imitates=_draw_pinfi,
    ),
    "pinfi-bugs": Strategy(
        name="pinfi-bugs (as pinfi, xmm10 to xmm15 taken for xmm0 to xmm5)",
        rule=Rule.INSTRUCTION,
        model=_PINFI_MODEL,
        imitates=_draw_pinfi_with_bugs,
    ),
}
