"""Properties of a processor that the injector needs, and the result of a run of single steps."""

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
    breakpoint_advance: int  # bytes by which the instruction pointer is past it at the trap
    breakpoint_length: int  # of a hardware breakpoint, as perf_event_open wants it, bytes
    perf_event_open: int  # system call number


class StepEnd(IntEnum):
    """Why the recording of single steps returned."""

    FULL = 0  # no room for more
    OUT_OF_SCOPE = 1  # foreign code is next
    NEEDS_CARE = 2  # the next instruction leaves traces of the stepping
    OTHER_STATUS = 3  # the report was not a step: see `status`
    WINDOW_END = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """The result of a run of single steps."""

    count: int  # addresses recorded
    why: StepEnd
    status: int  # the last wait status
