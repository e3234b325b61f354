"""Applies a source-level fault to the messages between kernels.

One mechanism for all of them: every message passes through `pass_on` when it is published, and
the trajectory that is being flown through `strike_latched` once a tick, because a plan lives for
many seconds and a fault may hit it at any moment of them.

What a strike changed is told to a listener *before* the changed message goes on, so that a record
survives whatever the fault does.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.states import Message, State
from mavfi_cli.core.types import CollisionReport, Command, Trajectory
from mavfi_cli.fi import bits as bit_operations
from mavfi_cli.fi.source.fault import Corruption, Effect, Persistence, SourceFault, When

M = TypeVar("M", CollisionReport, Trajectory, Command)

MAX_LISTED_STRIKES = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """One value that a strike changed."""

    state: str
    index: int  # waypoint, 0 for messages without rows
    bits: tuple[int, ...]
    before: float | int | bool
    after: float | int | bool
    before_hex: str
    after_hex: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Strike:
    """One moment at which the fault acted."""

    stamp_s: float
    tick: int
    phase: str
    invocation: int  # which output of the kernel it was
    changes: tuple[Change, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """Where the mission stands: what triggers are compared with."""

    stamp_s: float
    flight_s: float  # since the companion took over
    tick: int  # control ticks since then
    phase: str  # the pilot's mode


class SourceInjector:
    """Carries one fault through one mission.

    Args:
        fault: what to do.
        seed: root of the fault's random stream.
        shortest_flight_s: no flight of this mission can be shorter; a random time is drawn
            uniformly over it, so that it always comes.
        listener: told of every strike before its message goes on.

    Attributes:
        strikes: what was done, oldest first; at most MAX_LISTED_STRIKES of them.
        count: how many strikes there were.
    """

    def __init__(
        self,
        fault: SourceFault,
        *,
        seed: int,
        shortest_flight_s: float,
        listener: Callable[[Strike], None],
    ) -> None:
        self.fault = fault
        self.strikes: list[Strike] = []
        self.count = 0
        self._kind = fault.states[0].message
        self._rng = generator(seed, Stream.FAULT, "strike")
        self.drawn_time_s = float(self._rng.uniform(0.0, shortest_flight_s))
        self._listener = listener
        self._invocations = 0
        self._begun_s: float | None = None
        self._last_s = -math.inf
        self._index: int | None = None
        self._patterns: list[int] = []  # what the struck bits were set to, for stuck-at
        self._bits: list[tuple[int, ...]] = []
        self._struck: Message | None = None

    def pass_on(self, message: M, moment: Moment, index: int = 0) -> M:
        """A message as its receiver gets it.

        Args:
            index: the waypoint that is followed first, for a trajectory.
        """
        if type(message) is not self._kind:
            return message
        self._invocations += 1
        if type(message) is Trajectory and self._strikes_latched():
            return message
        return self._strike(message, moment, index) if self._due(moment) else message

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """The trajectory that is being flown, as it is from this tick on."""
        if self._kind is not Trajectory or not self._strikes_latched():
            return trajectory
        if trajectory is self._struck and self.fault.corruption.persistence is not (
            Persistence.INTERMITTENT
        ):
            return trajectory
        if not self._due(moment):
            return trajectory
        struck = self._strike(trajectory, moment, index)
        self._struck = struck
        return struck

    def _strikes_latched(self) -> bool:
        """An invocation is met on publication; every other trigger while the plan is flown."""
        return self.fault.trigger.when is not When.INVOCATION

    def _due(self, moment: Moment) -> bool:
        corruption = self.fault.corruption
        if self._begun_s is None:
            return self._reached(moment)
        if corruption.persistence is Persistence.TRANSIENT:
            return False
        if moment.stamp_s - self._begun_s >= corruption.duration_s:
            return False
        if corruption.persistence is Persistence.INTERMITTENT:
            return moment.stamp_s - self._last_s >= corruption.period_s - 1e-9
        return True

    def _reached(self, moment: Moment) -> bool:
        trigger = self.fault.trigger
        if trigger.when is When.TIME:
            return moment.flight_s >= trigger.number - 1e-9
        if trigger.when is When.TICK:
            return moment.tick >= trigger.number
        if trigger.when is When.PHASE:
            return moment.phase == trigger.phase
        if trigger.when is When.INVOCATION:
            return self._invocations >= trigger.number
        return moment.flight_s >= self.drawn_time_s

    def _strike(self, message: M, moment: Moment, first: int) -> M:
        rows = len(message.waypoints) if isinstance(message, Trajectory) else 1
        if self._begun_s is None:
            self._begun_s = moment.stamp_s
        self._last_s = moment.stamp_s
        if self._index is None or self._index >= rows:
            self._index = int(self._rng.integers(min(first, rows - 1), rows))
        changed: Any = message
        changes = []
        for place, state in enumerate(self.fault.states):
            change = self._change(place, state, changed)
            changed = state.write(changed, self._index, change.after)
            changes.append(change)
        strike = Strike(
            stamp_s=moment.stamp_s,
            tick=moment.tick,
            phase=moment.phase,
            invocation=self._invocations,
            changes=tuple(changes),
        )
        self.count += 1
        if len(self.strikes) < MAX_LISTED_STRIKES:
            self.strikes.append(strike)
        self._listener(strike)
        result: M = changed
        return result

    def _change(self, place: int, state: State, message: Message) -> Change:
        assert self._index is not None
        kind = bit_operations.NUMPY_TYPES[state.dtype.value]
        before = state.read(message, self._index)
        pattern = bit_operations.pattern_of(before, kind)
        if place >= len(self._bits):
            self._choose(place, kind, pattern)
        mask = bit_operations.mask_of(self._bits[place], kind)
        if self.fault.corruption.persistence is Persistence.INTERMITTENT and (
            self.fault.corruption.effect is Effect.FLIP
        ):
            corrupted = pattern ^ mask
        else:
            corrupted = pattern & ~mask | self._patterns[place] & mask
        return Change(
            state=state.name,
            index=self._index,
            bits=bit_operations.bits_of(pattern ^ corrupted),
            before=before,
            after=bit_operations.value_of(corrupted, kind),
            before_hex=f"{pattern:#0{kind.width // 4 + 2}x}",
            after_hex=f"{corrupted:#0{kind.width // 4 + 2}x}",
        )

    def _choose(self, place: int, kind: bit_operations.BitType, pattern: int) -> None:
        """Draw the bits of one state and what they are set to, once for the whole mission."""
        corruption: Corruption = self.fault.corruption
        if corruption.effect is Effect.FLIP:
            if self.fault.bits is not None:
                chosen = self.fault.bits[place]
            else:
                chosen = bit_operations.draw_bits(
                    self._rng, kind, field=corruption.field, count=corruption.bits
                )
            target = bit_operations.flip_pattern(pattern, chosen, kind)
        else:
            chosen = tuple(range(kind.width))
            target = 0
            if corruption.effect is Effect.RANDOM:
                drawn = self._rng.integers(0, 2, size=kind.width, dtype=np.uint8)
                target = sum(int(bit) << number for number, bit in enumerate(drawn))
        self._bits.append(tuple(chosen))
        self._patterns.append(target)
