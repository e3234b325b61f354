"""Source-level faults: injection site, trigger and corruption as three small frozen types.

Vocabulary: transient, intermittent and stuck-at faults as in Avizienis et al., "Basic concepts and
taxonomy of dependable and secure computing", IEEE TDSC 1(1), 2004.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

from mavfi_cli.core.errors import FaultSpecError
from mavfi_cli.core.states import State
from mavfi_cli.fi.bits import Field


class When(Enum):
    """The event that a trigger waits for."""

    TIME = "time"  # seconds after the companion took over
    TICK = "tick"  # control ticks after it took over
    PHASE = "phase"  # the pilot's mode
    FORESEEN = "foreseen"  # the first report of a foreseen collision
    INVOCATION = "invocation"  # the n-th output of the kernel
    RANDOM = "random"  # a time drawn over the flight from the fault's own stream


class Effect(Enum):
    """The change that a corruption makes to a value."""

    FLIP = "flip"
    ZERO = "zero"
    RANDOM = "random"  # every bit is drawn anew


class Persistence(Enum):
    """How long a corruption lasts."""

    TRANSIENT = "transient"
    STUCK_AT = "stuck-at"
    INTERMITTENT = "intermittent"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trigger:
    """When the fault strikes. PHASE uses the name, RANDOM and FORESEEN neither name nor number."""

    when: When = When.RANDOM
    number: float = 0.0  # seconds, ticks, or the count of the invocation (from 1)
    phase: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.number) and self.number >= 0.0):
            raise FaultSpecError(f"a trigger at {self.when.value} {self.number:g} is not possible")
        if self.when is When.INVOCATION and self.number < 1:
            raise FaultSpecError("invocations are counted from 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Corruption:
    """The change to each attacked value, and its duration.

    Attributes:
        bits: number of distinct bits of `field` that are flipped.
        duration_s: duration of a stuck-at or intermittent fault, s.
        period_s: time between two strikes of an intermittent fault, s.
    """

    effect: Effect = Effect.FLIP
    bits: int = 1
    field: Field = Field.ANY
    persistence: Persistence = Persistence.TRANSIENT
    duration_s: float = math.inf
    period_s: float = 1.0

    def __post_init__(self) -> None:
        if self.bits < 1:
            raise FaultSpecError(f"at least one bit must be flipped, not {self.bits}")
        if not self.duration_s > 0.0:
            raise FaultSpecError(f"a duration of {self.duration_s:g} s is not possible")
        if not (self.period_s > 0.0 and math.isfinite(self.period_s)):
            raise FaultSpecError(f"a period of {self.period_s:g} s is not possible")


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceFault:
    """One source-level fault.

    Attributes:
        states: the attacked states, all of one message. Several states are struck together,
            each with its own bits.
        bits: the exact bits of each state if they are prescribed, as in a replay; otherwise they
            are drawn.
    """

    states: tuple[State, ...]
    trigger: Trigger = field(default_factory=Trigger)
    corruption: Corruption = field(default_factory=Corruption)
    bits: tuple[tuple[int, ...], ...] | None = None
