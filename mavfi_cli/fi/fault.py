"""Source-level faults: injection site, trigger and corruption as three small frozen types.

`draw_fault` resolves a requested fault to one exact fault: it looks up names and draws the rest.
`inject` flips bits of one value, or of one element of an array, without a mission.

Vocabulary: transient, intermittent and stuck-at faults as in Avizienis et al., "Basic concepts and
taxonomy of dependable and secure computing", IEEE TDSC 1(1), 2004.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import FaultSpecError, UnknownName, named_member
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import BY_NAME, Stage, State
from mavfi_cli.fi.bits import NUMPY_TYPES, BitType, Field, Scalar


class When(Enum):
    """The event that a trigger waits for."""

    TIME = "time"  # seconds after the companion took over
    TICK = "tick"  # control ticks after it took over
    PHASE = "phase"  # the pilot's mode
    FORESEEN = "foreseen"  # the first report of a foreseen collision
    INVOCATION = "invocation"  # the n-th output of the kernel
    RANDOM = "random"  # a flight time drawn from the fault's own random stream


class Effect(Enum):
    """The change that a corruption makes to a value, to a message on a link, or to a process."""

    FLIP = "flip"  # on a process: it is killed
    ZERO = "zero"
    RANDOM = "random"  # all bits are replaced by random ones
    FREEZE = "freeze"  # the value stays as it was at the first strike
    DROP = "drop"
    LATE = "late"  # late=SECONDS
    TWICE = "twice"
    SWAP = "swap"  # the message is delivered after the next one of its kind
    STOP = "stop"  # the process is stopped
    SLOW = "slow"  # slow=SHARE of a processor


OF_VALUES = (Effect.FLIP, Effect.ZERO, Effect.RANDOM, Effect.FREEZE)
OF_MESSAGES = (Effect.DROP, Effect.LATE, Effect.TWICE, Effect.SWAP)
OF_PROCESSES = (Effect.FLIP, Effect.STOP, Effect.SLOW)


class Persistence(Enum):
    """How long a corruption lasts, and whether it recurs."""

    TRANSIENT = "transient"
    STUCK_AT = "stuck-at"
    INTERMITTENT = "intermittent"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trigger:
    """When a fault strikes.

    A trigger PHASE uses the field `phase`; RANDOM and FORESEEN use no further field; all other
    triggers use `number`.
    """

    when: When = When.RANDOM
    number: float = 0.0  # seconds, ticks, or the invocation's number (from 1)
    phase: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.number) and self.number >= 0.0):
            raise FaultSpecError(
                f"the number of trigger {self.when.value} must be finite and at least 0, "
                f"got {self.number:g}"
            )
        if self.when is When.INVOCATION and self.number < 1:
            raise FaultSpecError(
                f"the number of the invocation must be at least 1, got {self.number:g}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Corruption:
    """The change that a fault makes to a value, a message or a process, and how long it lasts.

    Attributes:
        bits: number of distinct bits of `field` that are flipped.
        duration_s: duration of a stuck-at or intermittent fault, s.
        period_s: interval between the strikes of an intermittent fault, s.
        amount: delay of a late message, s, or processor share of a slowed process.
    """

    effect: Effect = Effect.FLIP
    bits: int = 1
    field: Field = Field.ANY
    persistence: Persistence = Persistence.TRANSIENT
    duration_s: float = math.inf
    period_s: float = 1.0
    amount: float = 0.0

    def __post_init__(self) -> None:
        if self.bits < 1:
            raise FaultSpecError(f"bits must be at least 1, got {self.bits}")
        if not self.duration_s > 0.0:
            raise FaultSpecError(f"duration_s must be above 0, got {self.duration_s:g}")
        if not (self.period_s > 0.0 and math.isfinite(self.period_s)):
            raise FaultSpecError(f"period_s must be finite and above 0, got {self.period_s:g}")
        most = {Effect.LATE: 3600.0, Effect.SLOW: 1.0}.get(self.effect)
        if most is None and self.amount:
            raise FaultSpecError(f"{self.effect.value} takes no number, got {self.amount:g}")
        if most is not None and not 0.0 < self.amount <= most:
            raise FaultSpecError(
                f"{self.effect.value}=NUMBER must be above 0 and at most {most:g}, "
                f"got {self.amount:g}"
            )

    def require(self, name: str, kind: BitType, bits: Sequence[int] | None) -> None:
        """Raise an error if the corruption cannot be applied to values of type `kind`.

        Args:
            name: name of the attacked value in the error message.
            bits: the exact bits to flip; None if they are drawn.

        Raises:
            FaultSpecError: the type lacks an exact bit or the field, the field has too few bits, or
                the effect does not apply to values.
        """
        require_effect(name, self.effect, OF_VALUES)
        if bits is not None:
            kind.mask(bits)
        elif self.effect is Effect.FLIP and self.bits > len(kind.field_bits(self.field)):
            raise FaultSpecError(
                f"{name} is {kind.name}: the number of flipped bits in field {self.field.value} "
                f"must be at most {len(kind.field_bits(self.field))}, got {self.bits}"
            )


def require_effect(name: str, effect: Effect, known: Sequence[Effect]) -> None:
    """Raise an error if a target does not support an effect.

    Args:
        name: name of the target in the error message.
        known: the effects that the target supports.

    Raises:
        FaultSpecError: `effect` is not among `known`.
    """
    if effect not in known:
        values = ", ".join(own.value for own in known)
        raise FaultSpecError(f"{name}: effect must be one of {values}, got {effect.value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceFault:
    """One source-level fault: the states that it strikes, when it strikes, and how it changes them.

    Attributes:
        states: the attacked states, all of the same message. Several states are struck at once,
            each with its own bits.
        bits: the exact bits to flip in each state, as in a replay; None draws them.
    """

    states: tuple[State, ...]
    trigger: Trigger = field(default_factory=Trigger)
    corruption: Corruption = field(default_factory=Corruption)
    bits: tuple[tuple[int, ...], ...] | None = None


STAGES = {stage.value: stage.states for stage in Stage}
GROUPS = tuple(dict.fromkeys(state.group for state in BY_NAME.values()))


def draw_fault(
    target: str,
    *,
    seed: int,
    trigger: Trigger,
    corruption: Corruption,
    together: bool = False,
    bits: Sequence[int] | None = None,
    known: Mapping[str, State] = BY_NAME,
    wholes: Mapping[str, tuple[State, ...]] = STAGES,
) -> SourceFault:
    """Return a source-level fault in a target. If several states qualify, `seed` draws one.

    Args:
        target: a stage, a state, or a group of states. From a stage, one state that has the
            corruption's field is drawn; from a group, one state is drawn unless `together` is set.
        together: strike all states of the target's group at once, as the paper's Table III does
            with the three components of the acceleration.
        bits: exact bits to flip, the same for all states; None draws them at the strike.
        known: all states, keyed by name.
        wholes: states of each stage or message, keyed by its name.

    Raises:
        UnknownName: no stage, state or group is named `target`.
        FaultSpecError: a bit is outside the width, or the type lacks the field.
    """
    rng = Stream.FAULT.generator(seed, "site")
    states = _states(target, rng, together, corruption.field, known, wholes)
    for state in states:
        corruption.require(state.name, NUMPY_TYPES[state.dtype.value], bits)
    chosen = None if bits is None else tuple(tuple(sorted(bits)) for _ in states)
    return SourceFault(states=states, trigger=trigger, corruption=corruption, bits=chosen)


def _states(
    target: str,
    rng: np.random.Generator,
    together: bool,
    field: Field,
    known: Mapping[str, State],
    wholes: Mapping[str, tuple[State, ...]],
) -> tuple[State, ...]:
    def group(name: str) -> tuple[State, ...]:
        return tuple(state for state in known.values() if state.group == name)

    if target in known:
        candidates: tuple[State, ...] = (known[target],)
    elif members := group(target):
        candidates = members
    elif target in wholes:
        whole = wholes[target]
        has = [state for state in whole if field in NUMPY_TYPES[state.dtype.value].fields]
        candidates = tuple(has) or whole
    else:
        groups = (state.group for state in known.values())
        kind = "stage, state or group" if known is BY_NAME else "message or field"
        raise UnknownName(kind, target, {*wholes, *known, *groups})
    state = candidates[int(rng.integers(len(candidates)))]
    return group(state.group) if together else (state,)


# -- without a mission

Value = TypeVar("Value", bound=Scalar | np.generic | NDArray[Any])


def inject(
    value: Value,
    *,
    bits: int = 1,
    field: str | Field = Field.ANY,
    seed: int = 1,
    exact_bits: Sequence[int] | None = None,
) -> Value:
    """Flip bits of a value, or of one element of an array, and return the corrupted copy.

    The same arguments give the same flip. Injecting into the result with the same seed and the same
    bits restores the value.

    Args:
        value: Python float (binary64), int (int64) or bool, a numpy scalar, or an array of any
            shape with dtype float64, float32, bool or any integer. It is not changed.
        bits: Number of distinct bits to flip.
        field: Part of the value whose bits are flipped: sign, exponent, mantissa or any.
        seed: Seed from which the element and the bits are drawn, 0 or more.
        exact_bits: Bits to flip instead of drawn ones; bit 0 is the least significant.

    Raises:
        FaultSpecError: The type of the value is not supported, the array is empty, the type lacks
            the field or a bit of `exact_bits`, or the field has too few bits.
        UnknownName: No field has this name.
    """
    corrupted: NDArray[Any] = np.array(value)
    kind = NUMPY_TYPES.get(corrupted.dtype.name)
    if kind is None:
        known = ", ".join(NUMPY_TYPES)
        raise FaultSpecError(
            f"cannot flip bits of {corrupted.dtype.name}; the supported types are {known}"
        )
    if corrupted.size == 0:
        raise FaultSpecError("cannot flip bits of an empty array")
    rng = Stream.FAULT.generator(seed, "value")
    element = int(rng.integers(corrupted.size))
    chosen = exact_bits
    if chosen is None:
        chosen = kind.draw(rng, field=named_member(Field, "field", field), count=bits)
    corrupted.flat[element] = kind.flip(corrupted.flat[element].item(), chosen)
    if isinstance(value, np.ndarray):
        return cast(Value, corrupted)
    return cast(Value, corrupted[()] if isinstance(value, np.generic) else corrupted.item())
