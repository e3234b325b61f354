"""Decodes x86-64 instructions into the register bits and memory bytes that they read and write.

A bit is *read* if its value can change a result elsewhere: another bit of a register, memory, an
address or the control flow. It is *written* if it holds part of the result. A 32-bit write also
clears the upper half of the register, and a VEX-encoded one clears all other bits (Intel SDM volume
1, sections 3.4.1.1 and 14.1.1). Cleared bits are overwritten, but are not part of the result.

Capstone does the decoding. `vectors` has the tables for vector instructions. This module has the
exceptions for all others, the stack slots of push, pop, call and ret, and the properties that the
tracer needs to step over an instruction. tests/fi/tracer/test_operands.py checks all of it
against real executions.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import capstone
from capstone import x86

from mavfi_cli.fi.tracer.vectors import (
    ALL,
    VECTOR,
    Touched,
    low,
    vector_bits,
)

engine: Any = capstone.Cs(capstone.CS_ARCH_X86, capstone.CS_MODE_64)
engine.detail = True
BRANCHES = {
    x86.X86_GRP_JUMP, x86.X86_GRP_CALL, x86.X86_GRP_RET, x86.X86_GRP_IRET,
    x86.X86_GRP_BRANCH_RELATIVE,  # the only group of `loop`
}  # fmt: skip
_FULL = low(64)
GENERAL = (
    "rax", "rbx", "rcx", "rdx", "rsi", "rdi", "rbp", "rsp", "r8", "r9", "r10", "r11", "r12", "r13",
    "r14", "r15",
)  # fmt: skip
FLAG_BITS = {"cf": 0, "pf": 2, "af": 4, "zf": 6, "sf": 7, "df": 10, "of": 11}


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterUse:
    """Bits of a full register that an instruction reads or writes."""

    register: str
    mask: int  # bits that the instruction reads, or that hold part of its result
    clears: int  # for a write: all bits that always get a new value
    explicit: bool
    operand: str  # as the assembler names it: eax, xmm1, zf


@dataclass(frozen=True, slots=True, kw_only=True)
class _MemoryUse:
    """Memory that an instruction reads or writes, at base + index * scale + displacement."""

    base: str | None
    index: str | None = None
    scale: int = 1
    displacement: int
    segment: str | None = None
    size: int
    mask: int  # bits of the operand that are read or written
    reads: bool
    writes: bool

    @property
    def operand(self) -> str:
        """The operand in words, for a record."""
        parts = [part for part in (self.segment, self.base, self.index) if part]
        return f"{self.size} bytes at {'+'.join(parts)}{self.displacement:+#x}"

    def address(self, instruction: Instruction, read: Callable[[str], int]) -> int:
        """Return the address of the memory, given the registers before the instruction executes.

        `read` returns the value of a full register, given its name.
        """

        def value(name: str | None) -> int:
            named = _GENERAL.get(name or "")
            return 0 if named is None else read(named.full) & low(named.width) << named.shift

        base = instruction.next_address if self.base == "rip" else value(self.base)
        origin = read(f"{self.segment}_base") if self.segment in ("fs", "gs") else 0
        return base + value(self.index) * self.scale + self.displacement + origin & _FULL


@dataclass(frozen=True, slots=True, kw_only=True)
class Instruction:
    """One decoded instruction."""

    address: int
    raw: bytes
    mnemonic: str
    text: str
    reads: tuple[RegisterUse, ...]
    writes: tuple[RegisterUse, ...]
    memory: tuple[_MemoryUse, ...]
    elements: tuple[str | None, str | None]  # read, written: float64, float32 or neither
    scalar: bool  # computes with the lowest element of its registers only
    branches: bool  # a jump, a call or a return
    run_over: bool  # a single step does not suffice or leaves a trace

    @property
    def next_address(self) -> int:
        """Address of the following instruction."""
        return self.address + len(self.raw)


@functools.lru_cache(maxsize=65536)
def decode(code: bytes, address: int) -> Instruction | None:
    """Decode the instruction at the start of `code`, 16 bytes that begin at `address`.

    Returns None if the bytes are not an instruction.
    """
    decoded = next(engine.disasm(code, address, 1), None)
    if decoded is None:
        return None
    operands = _operands_of(decoded)
    return Instruction(
        address=address,
        raw=code[: decoded.size],
        mnemonic=decoded.mnemonic,
        text=f"{decoded.mnemonic} {decoded.op_str}".strip(),
        reads=tuple(operands.reads.values()),
        writes=tuple(operands.writes.values()),
        memory=(*_memory(decoded, operands), *_stack(decoded)),
        elements=_elements(decoded.mnemonic),
        scalar=decoded.mnemonic.endswith(("sd", "ss")) and "broadcast" not in decoded.mnemonic,
        branches=not BRANCHES.isdisjoint(decoded.groups),
        run_over=_run_over(decoded),
    )


def _run_over(decoded: Any) -> bool:
    """Return True if a single step does not suffice or leaves a trace.

    A step executes one iteration of a repeated string instruction. `rep ret` is a plain return.
    After a step over a pop of the flags, Linux attributes the trap flag to the program
    (`enable_single_step` in arch/x86/kernel/step.c) and leaves it set.
    """
    repeated = decoded.mnemonic.startswith("rep") and BRANCHES.isdisjoint(decoded.groups)
    return repeated or decoded.mnemonic in ("popfq", "popf")


_FLOATS = {"sd": "float64", "pd": "float64", "ss": "float32", "ps": "float32"}
_CONVERSION = re.compile(r"v?cvtt?(\w+)2(\w+)$")
_INTEGERS = re.compile(r"v?p\w*s[ds]$")  # of signed doublewords: pmaxsd, pabsd


def _elements(mnemonic: str) -> tuple[str | None, str | None]:
    """Return the float types that an instruction reads and writes, or None for other types."""
    if match := _CONVERSION.match(mnemonic):
        return _FLOATS.get(match[1]), _FLOATS.get(match[2])
    element = None if _INTEGERS.match(mnemonic) else _FLOATS.get(mnemonic[-2:])
    return element, element


def _memory(decoded: Any, operands: _Operands) -> list[_MemoryUse]:
    if decoded.mnemonic == "lea":
        return []

    def name(number: int) -> str | None:
        return str(decoded.reg_name(number)) if number else None

    return [
        _MemoryUse(
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
        for op, bits in zip(decoded.operands, operands.explicit, strict=True)
        if op.type == x86.X86_OP_MEM and (mask := bits.reads | bits.writes)
    ]


def _stack(decoded: Any) -> list[_MemoryUse]:
    mnemonic = decoded.mnemonic.split()[-1]  # without rep, bnd or notrack
    if mnemonic.startswith(("push", "call")):
        displacement, reads = -8, False
    elif mnemonic.startswith(("pop", "ret", "leave")) and not mnemonic.startswith("popcnt"):
        displacement, reads = 0, True
    else:
        return []
    return [
        _MemoryUse(
            base="rbp" if mnemonic == "leave" else "rsp",
            displacement=displacement,
            size=8,
            mask=_FULL,
            reads=reads,
            writes=not reads,
        )
    ]


# -- registers by name


_X87 = re.compile(r"st\((\d)\)$")


@dataclass(frozen=True, slots=True)
class _Named:
    """A named part of a full register: `width` bits, beginning at bit `shift`."""

    full: str
    shift: int
    width: int


def _general_names() -> dict[str, _Named]:
    table = {name: _Named(name, 0, 64) for name in GENERAL}
    for letter in "abcd":
        full = f"r{letter}x"
        table |= {f"e{letter}x": _Named(full, 0, 32), f"{letter}x": _Named(full, 0, 16)}
        table |= {f"{letter}l": _Named(full, 0, 8), f"{letter}h": _Named(full, 8, 8)}
    for pair in ("si", "di", "bp", "sp"):
        full = f"r{pair}"
        table |= {f"e{pair}": _Named(full, 0, 32), pair: _Named(full, 0, 16)}
        table |= {f"{pair}l": _Named(full, 0, 8)}
    for full in GENERAL[8:]:
        table |= {
            f"{full}{end}": _Named(full, 0, 8 * n) for end, n in (("d", 4), ("w", 2), ("b", 1))
        }
    return table


_GENERAL = _general_names()


@functools.cache
def _named(name: str) -> _Named | None:
    """Return the part of a full register that a name denotes.

    Returns None for flags, segments and control words. A vector register gets its 512-bit name on
    every processor, so that records agree.
    """
    if name in _GENERAL:
        return _GENERAL[name]
    if match := VECTOR.match(name):
        return _Named(f"zmm{match[2]}", 0, {"x": 128, "y": 256, "z": 512}[match[1]])
    if match := _X87.match(name):
        return _Named(f"st{match[1]}", 0, 80)
    return _Named(name, 0, 64) if re.match(r"(k|mm)\d$", name) else None


@dataclass(slots=True)
class _Operands:
    """All operands of one instruction."""

    reads: dict[str, RegisterUse] = field(default_factory=dict)
    writes: dict[str, RegisterUse] = field(default_factory=dict)
    explicit: tuple[Touched, ...] = ()  # one per operand that the assembler names

    def touch(self, name: str, bits: Touched, *, explicit: bool = False) -> None:
        """Add bits that are read or written, counted from the lowest bit of the register `name`."""
        named = _named(name)
        if named is None:
            return
        shift = named.shift
        if bits.reads:
            self._add(self.reads, name, named.full, bits.reads << shift, 0, explicit)
        if bits.writes or bits.clears:
            written, cleared = bits.writes << shift, bits.clears << shift
            self._add(self.writes, name, named.full, written, cleared, explicit)

    def flag(self, name: str, *, reads: bool, defined: bool, clears: bool) -> None:
        """Add a read or write of a flag; the mask is 0 where the manual leaves it undefined."""
        bit = 1 << FLAG_BITS[name]
        (self.reads if reads else self.writes)[name] = RegisterUse(
            register="rflags", mask=bit * defined, clears=bit * clears, explicit=False, operand=name
        )

    @staticmethod
    def _add(
        uses: dict[str, RegisterUse], name: str, full: str, mask: int, clears: int, explicit: bool
    ) -> None:
        if before := uses.get(full):
            mask, clears = mask | before.mask, clears | before.clears
            name = name if name == before.operand else full
            explicit = explicit or before.explicit
        uses[full] = RegisterUse(
            register=full, mask=mask, clears=clears, explicit=explicit, operand=name
        )


def _operands_of(decoded: Any) -> _Operands:
    """Return the operands that a decoded instruction reads and writes."""
    vector = vector_bits(decoded)
    all_of = _Operands(explicit=_bits(decoded) if vector is None else vector)
    for op, bits in zip(decoded.operands, all_of.explicit, strict=True):
        if op.type == x86.X86_OP_REG:
            all_of.touch(decoded.reg_name(op.reg), bits, explicit=True)
        elif op.type == x86.X86_OP_MEM and not decoded.mnemonic.startswith(_NO_ADDRESS):
            _address(decoded, op, all_of)
    for name, bits in _implicit(decoded):
        all_of.touch(name, bits)
    if x86.X86_GRP_FPU not in decoded.groups:
        _flags(decoded, all_of, vector is not None)
    return all_of


_NO_ADDRESS = ("nop", "prefetch")


def _address(decoded: Any, op: Any, all_of: _Operands) -> None:
    """Add base and index registers, without bits that the scale or a short result discards."""
    width = 8 * decoded.operands[0].size if decoded.mnemonic == "lea" else 64
    if op.mem.base and not (op.mem.index == op.mem.base and op.mem.scale == 1):
        all_of.touch(
            decoded.reg_name(op.mem.base), Touched(reads=_kept(decoded, op.mem.base, width))
        )
    if op.mem.index:
        twice = op.mem.index == op.mem.base and op.mem.scale == 1
        shift = op.mem.scale.bit_length() - 1 + twice
        mask = _kept(decoded, op.mem.index, width, shift)
        all_of.touch(decoded.reg_name(op.mem.index), Touched(reads=mask))


def _kept(decoded: Any, register: int, width: int, shift: int = 0) -> int:
    named = _named(decoded.reg_name(register))
    if named is None or VECTOR.match(decoded.reg_name(register)):
        return ALL if named is None else low(named.width)
    return low(min(width, named.width) - shift)


# -- explicit operands


_ZEROING = ("xor", "sub", "sbb")
_SHIFTS = ("shl", "sal", "shr", "sar", "rol", "ror", "rcl", "rcr", "shld", "shrd")
_MASK_OPERATION = re.compile(
    r"k(add|andn?|mov|not|x?n?or|ortest|shift[lr]|test|unpck[bwd])([bwdq])$"
)
_COUNTED = {"shlx": 0, "shrx": 0, "sarx": 0, "bextr": 16, "bzhi": 8}  # bits of the last operand
_BIT_TESTS = ("bt", "bts", "btr", "btc")


def _bits(decoded: Any) -> tuple[Touched, ...]:
    if decoded.mnemonic.startswith(_NO_ADDRESS):
        return tuple(Touched() for _ in decoded.operands)
    touched = tuple(_default(op, 8 * op.size) for op in decoded.operands)
    _except(decoded, touched)
    return touched


def _default(op: Any, width: int) -> Touched:
    """Return the bits according to capstone's access flags, as wide as the named operand."""
    mask = low(width)
    reads, writes = bool(op.access & capstone.CS_AC_READ), bool(op.access & capstone.CS_AC_WRITE)
    whole = mask if width < 32 else low(max(64, width))
    return Touched(reads=mask * reads, writes=mask * writes, clears=whole * writes)


def _except(decoded: Any, touched: tuple[Touched, ...]) -> None:
    """Correct the bits where capstone's access flags are wrong."""
    name = decoded.mnemonic.split()[-1]  # without lock or rep
    names = [decoded.reg_name(op.reg) for op in decoded.operands if op.type == x86.X86_OP_REG]
    width = 8 * decoded.operands[0].size if decoded.operands else 0
    if name in _ZEROING and len(names) == 2 and names[0] == names[1]:
        touched[0].reads = touched[1].reads = 0
    elif name.startswith("cmov"):  # it does not always write, but always clears the upper half
        touched[0].reads, touched[0].clears = 0, _FULL & ~low(32) if width == 32 else 0
    elif name.startswith("set"):  # capstone reports a read of its memory
        touched[0].reads, touched[0].writes, touched[0].clears = 0, low(8), low(8)
    elif name in ("bsf", "bsr"):  # it does not write if the source is zero
        touched[0].clears = 0
    elif name in _SHIFTS and names[-1:] == ["cl"]:
        touched[-1].reads = low(6 if width == 64 else 5)
    elif name in _COUNTED:
        touched[-1].reads = low(_COUNTED[name] or (6 if width == 64 else 5))
    elif name in _BIT_TESTS and len(names) == 2:
        touched[1].reads = low(width.bit_length() - 1)
    elif name == "cmpxchg":
        touched[0].reads = touched[0].writes = low(width)
        touched[0].clears = 0
    elif name.startswith(("cmps", "scas")):  # capstone reports no reads
        for bits in touched:
            bits.reads |= low(width)
    elif match := _MASK_OPERATION.match(name):
        _opmask(decoded, touched, match[1], {"b": 8, "w": 16, "d": 32, "q": 64}[match[2]])


def _opmask(decoded: Any, touched: tuple[Touched, ...], name: str, width: int) -> None:
    """Limit opmasks to the width of the suffix; capstone gives all of them 16 bits."""
    for op, bits in zip(decoded.operands, touched, strict=True):
        if op.type == x86.X86_OP_REG:
            read = width // 2 if name.startswith("unpck") else width
            bits.reads = bits.reads and low(read)
            bits.writes, bits.clears = bits.writes and low(width), bits.writes and _FULL


# -- implicit operands


_SIGN_COPIES = {"cwd": ("ax", "dx"), "cdq": ("eax", "edx"), "cqo": ("rax", "rdx")}
_CALL_READS = ("rax", "rdi", "rsi", "rdx", "r10", "r8", "r9")


def _implicit(decoded: Any) -> Iterator[tuple[str, Touched]]:
    name = decoded.mnemonic
    if pair := _SIGN_COPIES.get(name):
        width = _GENERAL[pair[0]].width
        yield pair[0], Touched(reads=1 << width - 1)
        yield pair[1], _whole(pair[1])
        return
    named = {op.reg for op in decoded.operands if op.type == x86.X86_OP_REG}
    for register in [number for number in decoded.regs_read if number not in named]:
        if not (name == "leave" and decoded.reg_name(register) == "rsp"):
            yield (
                decoded.reg_name(register),
                Touched(reads=_whole(decoded.reg_name(register)).writes),
            )
    for register in decoded.regs_write:
        yield decoded.reg_name(register), _written(name, decoded.reg_name(register))
    yield from _hidden(decoded)


def _whole(name: str) -> Touched:
    named = _named(name)
    if named is None:
        return Touched()
    mask = low(named.width)
    return Touched(writes=mask, clears=_FULL if named.width == 32 else mask)


def _written(mnemonic: str, name: str) -> Touched:
    if mnemonic in ("vzeroupper", "vzeroall"):
        return Touched(clears=ALL & ~low(128) if mnemonic == "vzeroupper" else ALL)
    return _whole(name)


def _hidden(decoded: Any) -> Iterator[tuple[str, Touched]]:
    """Yield registers that capstone omits, for system calls, x87 instructions and cmpxchg."""
    name = decoded.mnemonic.split()[-1]
    if name == "syscall":
        for register in _CALL_READS:
            yield register, Touched(reads=_FULL)
        for register in ("rax", "rcx", "r11"):
            yield register, _whole(register)
    elif name == "cmpxchg":
        accumulator = {1: "al", 2: "ax", 4: "eax", 8: "rax"}[decoded.operands[0].size]
        yield accumulator, Touched(writes=_whole(accumulator).writes)
    elif x86.X86_GRP_FPU in decoded.groups:
        if not name.startswith(("fld", "fild", "fbld")):
            yield "st(0)", Touched(reads=low(80))
        if not name.startswith(("fst", "fist", "fcom", "fucom", "ftst", "fxam")):
            yield "st(0)", _whole("st(0)")


# -- flags


_VECTOR_TESTS = re.compile(r"v?u?comis|v?p?test(p[sd])?$|v?pcmp[ei]str|kortest|ktest")
_ARITHMETIC_FLAGS = tuple(name for name in FLAG_BITS if name != "df")
_STRINGS = re.compile(r"(movs|stos|lods|scas|cmps|ins|outs)[bwdq]$|pushf")
_DIRECTIONS = ("cld", "std", "popf")
# Flags that capstone's tables omit: those read, then those written.
_LACKING_READS = {
    **dict.fromkeys(("rcl", "rcr", "cmc"), ("cf",)), "lahf": ("cf", "pf", "af", "zf", "sf"),
}  # fmt: skip
_LACKING_WRITES = {**dict.fromkeys(("lzcnt", "tzcnt", "cmc"), ("cf",))}
_UNDEFINED = {"imul": ("sf",)}  # Intel writes it, AMD keeps it
_HOW = ("TEST", "MODIFY", "RESET", "SET", "UNDEFINED")
_FLAGS = {
    (name, how): getattr(x86, f"X86_EFLAGS_{how}_{name.upper()}", 0)
    for name in FLAG_BITS
    for how in _HOW
}
_FLAGS["of", "RESET"] |= x86.X86_EFLAGS_RESET_0F  # capstone spells it with a zero


def _flags(decoded: Any, all_of: _Operands, vector: bool) -> None:
    mnemonic = decoded.mnemonic.split()[-1]
    if vector or mnemonic.startswith(
        "k"
    ):  # capstone gives the flags of another instruction with the same name
        for name in _ARITHMETIC_FLAGS if _VECTOR_TESTS.match(mnemonic) else ():
            all_of.flag(name, reads=False, defined=True, clears=True)
        return
    by_count = mnemonic in _SHIFTS and decoded.op_str.endswith("cl")  # a zero count changes no flag
    if _STRINGS.match(mnemonic):
        all_of.flag("df", reads=True, defined=True, clears=False)
    elif mnemonic.startswith(_DIRECTIONS):
        all_of.flag("df", reads=False, defined=True, clears=True)
    for name in _ARITHMETIC_FLAGS:
        how = {use for use in _HOW if decoded.eflags & _FLAGS[name, use]}
        if "TEST" in how or name in _LACKING_READS.get(mnemonic, ()):
            all_of.flag(name, reads=True, defined=True, clears=False)
        if how - {"TEST"} or name in _LACKING_WRITES.get(mnemonic, ()):
            undefined = "UNDEFINED" in how or name in _UNDEFINED.get(mnemonic, ())
            defined = not undefined or name in _LACKING_WRITES.get(mnemonic, ())
            all_of.flag(name, reads=False, defined=defined, clears=not by_count)
