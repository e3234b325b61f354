"""Types that are the same on every processor: operands of an instruction, traits, ends of steps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterUse:
    """Bits of a full register that an instruction reads or writes."""

    register: str
    mask: int  # bits that the instruction reads, or that hold a part of its result
    clears: int  # for a write: every bit that always gets a new value
    explicit: bool
    operand: str  # as the assembler names it: eax, xmm1, zf


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryUse:
    """Bytes that an instruction reads or writes: base + index * scale + displacement."""

    base: str | None
    index: str | None
    scale: int
    displacement: int
    segment: str | None
    size: int
    mask: int  # bits of it that are read or written
    reads: bool
    writes: bool

    @property
    def operand(self) -> str:
        """The operand as text, for a record."""
        parts = [part for part in (self.segment, self.base, self.index) if part]
        return f"{self.size} bytes at {'+'.join(parts)}{self.displacement:+#x}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Instruction:
    """One decoded instruction."""

    address: int
    raw: bytes
    mnemonic: str
    text: str
    reads: tuple[RegisterUse, ...]
    writes: tuple[RegisterUse, ...]
    memory: tuple[MemoryUse, ...]
    elements: tuple[str | None, str | None]  # float64 or float32, if it reads or writes them
    scalar: bool  # it computes with the lowest element of its registers only
    branches: bool  # it is a jump, a call or a return
    run_over: bool  # one single step is not enough or leaves a trace: run past it

    @property
    def next_address(self) -> int:
        """Address of the following instruction."""
        return self.address + len(self.raw)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Flow:
    """How control flows through one instruction, and whether it can be executed elsewhere."""

    size: int
    straight: bool  # the next instruction follows, always
    movable: bool
    repeated: bool  # a string instruction that may repeat itself


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What a system call asks for; the defaults for one that does not matter."""

    path: str = ""
    folder: int | None = None  # descriptor of the folder of a relative path; None: the working one
    writes: bool = False  # it changes the file or folder
    terminal: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """One processor architecture under Linux."""

    instruction_pointer: str
    flags_register: str
    flags: int  # bits of that register which instructions read and write
    vector_bits: int  # no vector register is wider
    breakpoint: bytes  # software breakpoint instruction
    breakpoint_advance: int  # bytes by which the instruction pointer is past it at the trap
    breakpoint_length: int  # of a hardware breakpoint, as perf_event_open wants it, bytes
    perf_event_open: int  # system call numbers
    mmap: int
    munmap: int
    system_call: bytes  # the instruction
    jump_bytes: int  # of a jump to anywhere near
    short_jump_bytes: int
    short_jump: range  # where a short jump leads, from its own address


class StepEnd(IntEnum):
    """Why the recording of single steps returned."""

    FULL = 0  # no room for more
    OUT_OF_SCOPE = 1  # foreign code is next
    NEEDS_CARE = 2  # the next instruction leaves traces of the stepping
    OTHER_STATUS = 3  # the wait status was not that of a step
    WINDOW_END = 4
