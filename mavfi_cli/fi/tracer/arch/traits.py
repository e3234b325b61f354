"""What the injector asks of a processor, and what it is told by a run of single steps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """One processor architecture under Linux."""

    instruction_pointer: str
    stack_pointer: str
    vector_bits: int  # no vector register is wider
    breakpoint: bytes  # software breakpoint instruction
    breakpoint_advance: int  # how far the instruction pointer is past it when it traps
    breakpoint_length: int  # of a hardware breakpoint, as perf_event_open wants it, bytes
    perf_event_open: int  # system call number


class StepEnd(IntEnum):
    """Why the recording of single steps came back."""

    FULL = 0  # no room for more
    OUT_OF_SCOPE = 1  # foreign code is next
    NEEDS_CARE = 2  # the next instruction leaves traces of the stepping
    OTHER_STATUS = 3  # something else than a step was reported: `status`
    WINDOW_END = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """What a run of single steps recorded."""

    count: int  # addresses recorded
    why: StepEnd
    status: int  # the last wait status
