"""A source-level fault = site x trigger x corruption: three small frozen types.

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
    """What a trigger waits for."""

    TIME = "time"  # seconds after the companion took over
    TICK = "tick"  # control ticks after it took over
    PHASE = "phase"  # the pilot's mode
    FORESEEN = "foreseen"  # the first report of a foreseen collision
    INVOCATION = "invocation"  # the n-th output of the kernel
    RANDOM = "random"  # a time drawn over the flight from the fault's own stream


class Effect(Enum):
    """What happens to the value."""

    FLIP = "flip"
    ZERO = "zero"
    RANDOM = "random"  # every bit drawn anew


class Persistence(Enum):
    """How long it happens."""

    TRANSIENT = "transient"
    STUCK_AT = "stuck-at"
    INTERMITTENT = "intermittent"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trigger:
    """When the fault strikes. RANDOM and FORESEEN use neither number nor name, PHASE the name."""

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
    """What is done to each attacked value, and for how long.

    Attributes:
        bits: how many distinct bits of `field` are flipped.
        duration_s: how long a stuck-at or intermittent fault goes on.
        period_s: from one strike of an intermittent fault to the next.
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
        states: the attacked states, all of one message; several are struck together, each with
            bits of its own.
        bits: the exact bits of each state, where they are prescribed (a replay, a user's wish);
            otherwise they are drawn.
    """

    states: tuple[State, ...]
    trigger: Trigger = field(default_factory=Trigger)
    corruption: Corruption = field(default_factory=Corruption)
    bits: tuple[tuple[int, ...], ...] | None = None
