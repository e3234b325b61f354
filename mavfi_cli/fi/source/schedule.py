"""Schedule and bit pattern of a fault, shared by all injectors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mavfi_cli.fi import bits as bit_operations
from mavfi_cli.fi.source.fault import Corruption, Effect, Persistence, Trigger, When


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """The mission's present state, which triggers are compared with."""

    stamp_s: float
    flight_s: float  # since the companion took over
    tick: int  # control ticks since then
    phase: str  # the pilot's mode
    foresees: bool = False  # a report of a foreseen collision is being passed on


class Schedule:
    """Decides at which moments a fault strikes.

    Args:
        drawn_time_s: flight time of a random trigger, s.
    """

    def __init__(self, trigger: Trigger, corruption: Corruption, drawn_time_s: float) -> None:
        self._came = False  # the trigger came, whether or not there was anything to strike
        self._trigger = trigger
        self._corruption = corruption
        self._drawn_time_s = drawn_time_s
        self._begun_s: float | None = None
        self._last_s = -math.inf

    def watch(self, moment: Moment) -> None:
        """Note the mission's present state, even if there is nothing to strike.

        A phase may begin and end before the next message with the attacked state.
        """
        self._came = self._came or self._comes(moment)

    def missed(self, what: str) -> str:
        """The reason if the fault never struck; `what` is what it waited for, such as "report"."""
        trigger = self._trigger
        never, since = {
            When.PHASE: (
                f"the pilot was never in phase {trigger.phase}",
                f"phase {trigger.phase} had begun",
            ),
            When.FORESEEN: ("no collision was ever foreseen", "a collision was first foreseen"),
        }.get(trigger.when, ("the mission ended before the trigger", "the trigger"))
        return f"no {what} came after {since}" if self._came else never

    def due(self, moment: Moment, invocations: int = 0) -> bool:
        """True if the fault strikes now; `invocations` counts the kernel's outputs so far."""
        self.watch(moment)
        corruption = self._corruption
        if self._begun_s is None:
            return self._reached(moment, invocations)
        if corruption.persistence is Persistence.TRANSIENT:
            return False
        if moment.stamp_s - self._begun_s >= corruption.duration_s:
            return False
        if corruption.persistence is Persistence.INTERMITTENT:
            return moment.stamp_s - self._last_s >= corruption.period_s - 1e-9
        return True

    def acted(self, moment: Moment) -> None:
        """Note a strike."""
        if self._begun_s is None:
            self._begun_s = moment.stamp_s
        self._last_s = moment.stamp_s

    def _reached(self, moment: Moment, invocations: int) -> bool:
        trigger = self._trigger
        if trigger.when in (When.PHASE, When.FORESEEN):
            return self._came
        if trigger.when is When.INVOCATION:
            return invocations >= trigger.number
        return self._comes(moment)

    def _comes(self, moment: Moment) -> bool:
        """True if the trigger has come; invocations are counted with the messages instead."""
        trigger = self._trigger
        if trigger.when is When.TIME:
            return moment.flight_s >= trigger.number - 1e-9
        if trigger.when is When.TICK:
            return moment.tick >= trigger.number
        if trigger.when is When.PHASE:
            return moment.phase == trigger.phase
        if trigger.when is When.FORESEEN:
            return moment.foresees
        if trigger.when is When.INVOCATION:
            return False
        return moment.flight_s >= self._drawn_time_s


class Pattern:
    """The corruption of one value: its bits and what they are set to, drawn once.

    Args:
        bits: the exact bits; None draws them at the first strike.
    """

    def __init__(
        self, corruption: Corruption, rng: np.random.Generator, bits: tuple[int, ...] | None
    ) -> None:
        self._corruption = corruption
        self._rng = rng
        self._prescribed = bits
        self._bits: tuple[int, ...] | None = None
        self._target = 0

    def corrupt(self, pattern: int, kind: bit_operations.BitType) -> int:
        """Return the pattern after a strike."""
        if self._bits is None:
            self._bits = self._choose(pattern, kind)
        mask = bit_operations.mask_of(self._bits, kind)
        corruption = self._corruption
        if corruption.persistence is Persistence.INTERMITTENT and corruption.effect is Effect.FLIP:
            return pattern ^ mask
        return pattern & ~mask | self._target & mask

    def _choose(self, pattern: int, kind: bit_operations.BitType) -> tuple[int, ...]:
        corruption = self._corruption
        if corruption.effect is Effect.FLIP:
            chosen = self._prescribed
            if chosen is None:
                chosen = bit_operations.draw_bits(
                    self._rng, kind, field=corruption.field, count=corruption.bits
                )
            self._target = bit_operations.flip_pattern(pattern, chosen, kind)
            return chosen
        if corruption.effect is Effect.RANDOM:
            drawn = self._rng.integers(0, 2, size=kind.width, dtype=np.uint8)
            self._target = sum(int(bit) << number for number, bit in enumerate(drawn))
        return tuple(range(kind.width))
