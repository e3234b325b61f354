"""Applies a source-level fault to the messages between kernels.

Every message passes through `pass_on` when it is published. The active plan also passes through
`strike_latched` once a tick, because it lives for many seconds and a fault may hit it anytime.

A listener hears of each strike *before* the changed message goes on, so that the record survives
whatever the fault does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.states import Message, Scalar, State
from mavfi_cli.core.types import CollisionReport, Command, Trajectory
from mavfi_cli.fi import bits as bit_operations
from mavfi_cli.fi.source.fault import Persistence, SourceFault, When
from mavfi_cli.fi.source.schedule import Moment, Pattern, Schedule

M = TypeVar("M")

MAX_LISTED_STRIKES = 100
_WORDS: dict[type, str] = {CollisionReport: "report", Trajectory: "plan", Command: "command"}


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
    invocation: int  # number of the kernel's output
    changes: tuple[Change, ...]


class SourceInjector:
    """Carries one fault through one mission.

    Args:
        fault: the fault.
        seed: root of the fault's random stream.
        shortest_flight_s: lower bound of the mission's flight time. A random time is drawn
            uniformly over it, so that the trigger always comes.
        listener: called with every strike before its message goes on.

    Attributes:
        strikes: the strikes, oldest first, at most MAX_LISTED_STRIKES.
        count: number of strikes.
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
        self._schedule = Schedule(fault.trigger, fault.corruption, self.drawn_time_s)
        self._index: int | None = None
        self._patterns = [
            Pattern(fault.corruption, self._rng, None if fault.bits is None else fault.bits[place])
            for place in range(len(fault.states))
        ]
        self._struck: Message | None = None

    def watch(self, moment: Moment) -> None:
        """Note the mission's present state, once a control tick and for every report."""
        self._schedule.watch(moment)

    @property
    def missed(self) -> str:
        """The reason if the fault never struck."""
        return self._schedule.missed(_WORDS[self._kind])

    def pass_on(self, message: M, moment: Moment, index: int = 0) -> M:
        """Return the message as its receiver gets it.

        Args:
            index: for a trajectory, the waypoint that is followed first.
        """
        if type(message) is not self._kind:
            return message
        self._invocations += 1
        if type(message) is Trajectory and self._strikes_latched():
            return message
        if not self._schedule.due(moment, self._invocations):
            return message
        return self._strike(message, moment, index)

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """Return the active plan as it is from this tick on."""
        if self._kind is not Trajectory or not self._strikes_latched():
            return trajectory
        if trajectory is self._struck and self.fault.corruption.persistence is not (
            Persistence.INTERMITTENT
        ):
            return trajectory
        if not self._schedule.due(moment, self._invocations):
            return trajectory
        struck = self._strike(trajectory, moment, index)
        self._struck = struck
        return struck

    def _strikes_latched(self) -> bool:
        """True for every trigger but an invocation, which is met on publication."""
        return self.fault.trigger.when is not When.INVOCATION

    def _strike(self, message: M, moment: Moment, first: int) -> M:
        rows = len(message.waypoints) if isinstance(message, Trajectory) else 1
        self._schedule.acted(moment)
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
        return change_of(state.name, self._index, before, kind, self._patterns[place])


def change_of(
    name: str, index: int, before: Scalar, kind: bit_operations.BitType, corruption: Pattern
) -> Change:
    """Return the change that a strike makes to one value."""
    pattern = bit_operations.pattern_of(before, kind)
    corrupted = corruption.corrupt(pattern, kind)
    return Change(
        state=name,
        index=index,
        bits=bit_operations.bits_of(pattern ^ corrupted),
        before=before,
        after=bit_operations.value_of(corrupted, kind),
        before_hex=f"{pattern:#0{kind.width // 4 + 2}x}",
        after_hex=f"{corrupted:#0{kind.width // 4 + 2}x}",
    )
