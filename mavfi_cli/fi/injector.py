"""Injects source-level faults into the messages between kernels, or into a detector's memory.

Every message passes through `pass_on` when it is published. The active plan also passes through
`strike_latched` once per tick, because it stays active for many ticks and a fault may strike in any
of them.

A listener is called with a strike *before* the changed message is passed on, so that the record
survives any effect of the fault.

A `Follower` determines whether a corrupted value was read before it was replaced. A corruption that
nobody reads shows nothing about the system's resilience. `Activation` uses the terms of the
instruction level where they apply (`fi.tracer.inject.BitActivation`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import FaultSpecError, UnknownName
from mavfi_cli.core.flight_record import Change, Reader, Strike
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import CollisionReport, Command, Message, Scalar, State, Trajectory
from mavfi_cli.fi.bits import NUMPY_TYPES, BitType, bits_of
from mavfi_cli.fi.fault import (
    Corruption,
    Effect,
    Persistence,
    SourceFault,
    Trigger,
    When,
)

M = TypeVar("M")

_MAX_LISTED_STRIKES = 100
_WORDS: dict[type, str] = {CollisionReport: "report", Trajectory: "plan", Command: "command"}


class Moment(NamedTuple):
    """A snapshot of the mission. Triggers are checked against it."""

    stamp_s: float
    flight_s: float  # since the companion took over
    tick: int  # control ticks since then
    phase: str  # the pilot's mode
    foresees: bool = False  # a report of a foreseen collision is being passed on


class Pattern:
    """The corruption of one value: its bits and their new values, fixed at the first strike.

    Args:
        bits: the exact bits to flip; None draws them at the first strike.
    """

    def __init__(
        self, corruption: Corruption, rng: np.random.Generator, bits: tuple[int, ...] | None
    ) -> None:
        self._corruption = corruption
        self._rng = rng
        self._prescribed = bits
        self._bits: tuple[int, ...] | None = None
        self._target = 0

    def corrupt(self, pattern: int, kind: BitType) -> int:
        """Return the bit pattern of a value of type `kind` with the corruption applied."""
        if self._bits is None:
            self._bits = self._choose(pattern, kind)
        mask = kind.mask(self._bits)
        corruption = self._corruption
        if corruption.persistence is Persistence.INTERMITTENT and corruption.effect is Effect.FLIP:
            return pattern ^ mask
        return pattern & ~mask | self._target & mask

    def _choose(self, pattern: int, kind: BitType) -> tuple[int, ...]:
        corruption = self._corruption
        if corruption.effect is Effect.FLIP:
            chosen = self._prescribed
            if chosen is None:
                chosen = kind.draw(self._rng, field=corruption.field, count=corruption.bits)
            self._target = pattern ^ kind.mask(chosen)
            return chosen
        if corruption.effect is Effect.RANDOM:
            drawn = self._rng.integers(0, 2, size=kind.width, dtype=np.uint8)
            self._target = sum(int(bit) << number for number, bit in enumerate(drawn))
        if corruption.effect is Effect.FREEZE:
            self._target = pattern
        return tuple(range(kind.width))


Listener = Callable[[Strike], None]


class NoInjector:
    """A null object: an injector that changes nothing.

    Attributes:
        follower: determines who reads a struck value.
    """

    def __init__(self) -> None:
        self.follower = Follower()

    def watch(self, moment: Moment) -> None:
        """Check whether the trigger has occurred. Called once per control tick and per report."""

    def pass_on(self, message: M, moment: Moment) -> M:
        """Return a published message, corrupted if the fault strikes it."""
        return message

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """Return the active plan, corrupted if the fault strikes it.

        `index` is the plan's current waypoint.
        """
        return trajectory

    def strike(self, moment: Moment) -> None:
        """Strike memory or a process if the fault is due. Called once per control tick."""


class Injector(NoInjector):
    """Schedules and records the strikes of one fault. Subclasses strike messages or memory.

    Args:
        rng: random generator. Its first draw is the time of a random trigger.
        shortest_flight_s: lower bound on the mission's flight time. The time of a random trigger is
            drawn uniformly below this bound, so that every flight reaches the trigger.
        listener: called with every strike before the mission continues.
    """

    _awaits: str  # description of the event that the fault waits for

    def __init__(
        self,
        rng: np.random.Generator,
        trigger: Trigger,
        corruption: Corruption,
        shortest_flight_s: float,
        listener: Listener,
    ) -> None:
        super().__init__()
        self.drawn_time_s = float(rng.uniform(0.0, shortest_flight_s))
        self._trigger, self._corruption = trigger, corruption
        self._triggered = False  # the trigger has occurred, even if there was nothing to strike
        self._begun_s: float | None = None
        self._last_s = -math.inf
        self._listener = listener
        self.strikes: list[Strike] = []
        self.count = 0

    def watch(self, moment: Moment) -> None:
        """Check whether the trigger has occurred, even at a moment with nothing to strike.

        Otherwise, a phase that ends before the next message with the attacked state is missed.
        """
        self._triggered = self._triggered or self._is_triggered(moment)

    @property
    def missed(self) -> str:
        """The reason why the fault never struck."""
        never, since = {
            When.PHASE: (
                f"the pilot was never in phase {self._trigger.phase}",
                f"phase {self._trigger.phase} had begun",
            ),
            When.FORESEEN: ("no collision was ever foreseen", "a collision was first foreseen"),
        }.get(self._trigger.when, ("the mission ended before the trigger", "the trigger"))
        return f"no {self._awaits} came after {since}" if self._triggered else never

    def _due(self, moment: Moment, invocations: int = 0) -> bool:
        """Return True if the fault strikes now. `invocations` is the number of outputs so far."""
        self.watch(moment)
        corruption = self._corruption
        if self._begun_s is None:
            if self._trigger.when is When.INVOCATION:
                return invocations >= self._trigger.number
            lasts = self._trigger.when in (When.PHASE, When.FORESEEN)
            return self._triggered if lasts else self._is_triggered(moment)
        if corruption.persistence is Persistence.TRANSIENT:
            return False
        if moment.stamp_s - self._begun_s >= corruption.duration_s:
            return False
        if corruption.persistence is Persistence.INTERMITTENT:
            return moment.stamp_s - self._last_s >= corruption.period_s - 1e-9
        return True

    def _is_triggered(self, moment: Moment) -> bool:
        """Return True if the trigger has occurred. Only `_due` checks a trigger by invocation."""
        trigger = self._trigger
        return {
            When.TIME: moment.flight_s >= trigger.number - 1e-9,
            When.TICK: moment.tick >= trigger.number,
            When.PHASE: moment.phase == trigger.phase,
            When.FORESEEN: moment.foresees,
            When.INVOCATION: False,
            When.RANDOM: moment.flight_s >= self.drawn_time_s,
        }[trigger.when]

    def _record(self, moment: Moment, invocation: int, changes: Sequence[Change]) -> Strike:
        self._begun_s = moment.stamp_s if self._begun_s is None else self._begun_s
        self._last_s = moment.stamp_s
        strike = Strike(
            stamp_s=moment.stamp_s,
            tick=moment.tick,
            phase=moment.phase,
            invocation=invocation,
            changes=tuple(changes),
        )
        self.count += 1
        if len(self.strikes) < _MAX_LISTED_STRIKES:
            self.strikes.append(strike)
        self._listener(strike)
        return strike


class SourceInjector(Injector):
    """Injects one fault into the messages, or into the active plan, of one mission."""

    def __init__(
        self, fault: SourceFault, *, seed: int, shortest_flight_s: float, listener: Listener
    ) -> None:
        self.fault = fault
        self._kind = fault.states[0].message
        self._rng = Stream.FAULT.generator(seed, "strike")
        super().__init__(self._rng, fault.trigger, fault.corruption, shortest_flight_s, listener)
        self._awaits = _WORDS[self._kind]
        self._invocations = 0
        self._index: int | None = None
        self._patterns = [
            Pattern(fault.corruption, self._rng, None if fault.bits is None else fault.bits[place])
            for place in range(len(fault.states))
        ]
        self._struck: Message | None = None

    def pass_on(self, message: M, moment: Moment) -> M:
        """Return a published message, corrupted if the fault strikes it."""
        if type(message) is not self._kind:
            return message
        self._invocations += 1
        if type(message) is Trajectory and self._strikes_latched():
            return message
        if not self._due(moment, self._invocations):
            return message
        return self._strike(message, moment, 0)

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """Return the active plan, corrupted if the fault strikes it in this tick."""
        if self._kind is not Trajectory or not self._strikes_latched():
            return trajectory
        if trajectory is self._struck and self.fault.corruption.persistence is not (
            Persistence.INTERMITTENT
        ):
            return trajectory
        if not self._due(moment, self._invocations):
            return trajectory
        struck = self._strike(trajectory, moment, index)
        self._struck = struck
        return struck

    def _strikes_latched(self) -> bool:
        """Return True if the fault may strike an active plan, not only a newly published one.

        A trigger by invocation is checked only when a plan is published.
        """
        return self.fault.trigger.when is not When.INVOCATION

    def _strike(self, message: M, moment: Moment, first: int) -> M:
        rows = len(message.waypoints) if isinstance(message, Trajectory) else 1
        if self._index is None or self._index >= rows:
            self._index = int(self._rng.integers(min(first, rows - 1), rows))
        changed: Any = message
        changes = []
        for place, state in enumerate(self.fault.states):
            change = self._change(place, state, changed)
            assert change.after is not None
            changed = state.write(changed, self._index, change.after)
            changes.append(change)
        # If nothing changed, keep the same object: it may still hold an unread earlier strike.
        struck: Any = changed if any(change.bits for change in changes) else message
        self.follower.struck(struck, self._record(moment, self._invocations, changes))
        result: M = struck
        return result

    def _change(self, place: int, state: State, message: Message) -> Change:
        assert self._index is not None
        kind = NUMPY_TYPES[state.dtype.value]
        before = state.read(message, self._index)
        return change_of(state.name, self._index, before, kind, self._patterns[place])


def change_of(name: str, index: int, before: Scalar, kind: BitType, corruption: Pattern) -> Change:
    """Return the change that `corruption` makes to the value `before`, as a strike records it."""
    pattern = kind.pattern(before)
    corrupted = corruption.corrupt(pattern, kind)
    return Change(
        state=name,
        index=index,
        bits=bits_of(pattern ^ corrupted),
        before=before,
        after=kind.value(corrupted),
        before_hex=f"{pattern:#0{kind.width // 4 + 2}x}",
        after_hex=f"{corrupted:#0{kind.width // 4 + 2}x}",
    )


_REHEARSED = (
    CollisionReport(stamp_s=0.0, collision=False, time_to_collision_s=1.0, future_collision_seq=0),
    Trajectory(
        stamp_s=0.0, waypoints=np.ones((2, 10)), durations_s=np.ones(2), trajectory_seq=0,
        future_collision_seq=0,
    ),
    Command(stamp_s=0.0, velocity_enu_mps=np.ones(3), yaw_rad=1.0),
)  # fmt: skip


def rehearsed(fault: SourceFault, seed: int) -> tuple[float, Strike]:
    """Draw the moment and the bits of a random fault without a flight.

    Returns:
        The moment as a fraction of the shortest possible flight, and a strike with the bits of each
        state. In a flight, the bits differ if only a plan's last waypoint can be struck, because
        then no waypoint is drawn.
    """
    injector = SourceInjector(
        fault, seed=seed, shortest_flight_s=1.0, listener=lambda _strike: None
    )
    due = Moment(stamp_s=0.0, flight_s=1.0, tick=0, phase="")
    for message in _REHEARSED:
        injector.pass_on(message, due)
        if isinstance(message, Trajectory):
            injector.strike_latched(message, due, 0)
    return injector.drawn_time_s, injector.strikes[0]


Memory = Mapping[str, NDArray[Any]]


class MemoryInjector(Injector):
    """Injects one fault into one element of an array in a detector's memory, during one mission.

    The memory consists of the detector's thresholds, means and weights.

    Args:
        memory: the arrays, keyed by name.
        array: name of the attacked array; None draws one with probability proportional to its size
            in bytes.
        trigger: when to strike; an invocation is a control tick.
        shortest_flight_s, listener: as for `Injector`.

    Attributes:
        array, element: name of the attacked array, and index of the element in C order.

    Raises:
        UnknownName: no array has this name.
        FaultSpecError: the array has no elements, its elements lack the bits or the field, or the
            field has too few bits.
    """

    _awaits = "control tick"

    def __init__(
        self,
        memory: Memory,
        array: str | None,
        *,
        trigger: Trigger,
        corruption: Corruption,
        bits: Sequence[int] | None,
        seed: int,
        shortest_flight_s: float,
        listener: Listener,
    ) -> None:
        if array is not None and array not in memory:
            raise UnknownName("array in the detector's memory", array, memory)
        rng = Stream.FAULT.generator(seed, "memory")
        super().__init__(rng, trigger, corruption, shortest_flight_s, listener)
        names = sorted(memory)
        if array is None:
            sizes = np.array([memory[name].nbytes for name in names], dtype=np.float64)
            array = names[int(rng.choice(len(names), p=sizes / sizes.sum()))]
        if memory[array].size == 0:
            raise FaultSpecError(f"{array} has no elements, so a fault cannot strike it")
        self.array = array
        self.element = int(rng.integers(memory[array].size))
        self._kind = NUMPY_TYPES[memory[array].dtype.name]
        corruption.require(array, self._kind, bits)
        self._memory = memory
        chosen = None if bits is None else tuple(sorted(bits))
        self._pattern = Pattern(corruption, rng, chosen)

    def strike(self, moment: Moment) -> None:
        """Record the strike and corrupt the array element, if the fault is due."""
        if not self._due(moment, moment.tick):
            return
        place = self._memory[self.array]
        before = place.flat[self.element].item()
        change = change_of(self.array, self.element, before, self._kind, self._pattern)
        self._record(moment, moment.tick, [change])
        place.flat[self.element] = change.after


class Activation(Enum):
    """What happened to the corrupted values, over all strikes of a fault."""

    READ = "read"  # a receiver worked with a corrupted value
    WITHHELD = "withheld"  # the detector's gate withheld it from its receivers
    OVERWRITTEN = "overwritten"  # the message was replaced before anyone read it
    NOT_READ = "not_read"  # the mission ended before anyone read it
    UNCHANGED = "unchanged"  # the strike did not change the value
    NOT_INJECTED = "not_injected"


class Follower:
    """Follows the struck message until one of its corrupted values is read.

    Attributes:
        activation: the activation so far; READ is final, WITHHELD lasts until a value is read.
        reader: the first reader.
    """

    def __init__(self) -> None:
        self.activation = Activation.NOT_INJECTED
        self.reader: Reader | None = None
        self._message: Message | None = None
        self._corrupted: dict[str, int] = {}  # state -> waypoint

    @property
    def waits(self) -> bool:
        """True while a corrupted value may still be read."""
        return self._message is not None

    def struck(self, message: Message, strike: Strike) -> None:
        """Record a strike, and follow `message`, the struck message, if the strike changed it."""
        if self.activation is Activation.READ:
            return
        corrupted = {c.state: c.index for c in strike.changes if c.bits}
        if corrupted:
            self._message, self._corrupted = message, corrupted
            self._become(Activation.NOT_READ)
        elif self.activation is Activation.NOT_INJECTED:
            self.activation = Activation.UNCHANGED

    def read(
        self,
        message: Message | None,
        by: str,
        stamp_s: float,
        states: Collection[str],
        index: int | None = None,
    ) -> None:
        """Record that the receiver `by` reads `states` of a message.

        `index` is the waypoint at which it reads them; None means all waypoints.
        """
        if self._message is None or message is not self._message:
            return
        for state, at in self._corrupted.items():
            if state in states and index in (None, at):
                self.activation, self._message = Activation.READ, None
                self.reader = Reader(name=by, stamp_s=stamp_s, state=state)
                return

    def withheld(self, message: Message) -> None:
        """Record that the gate withheld a message, or the struck part of it."""
        if message is self._message:
            self.activation, self._message = Activation.WITHHELD, None

    def settle(self, held: Callable[[Message], bool]) -> None:
        """Record the struck message as overwritten, unless `held` returns True for it."""
        if self._message is not None and not held(self._message):
            self._message = None
            self._become(Activation.OVERWRITTEN)

    def _become(self, activation: Activation) -> None:
        """Set the activation, unless an earlier strike left it at WITHHELD."""
        if self.activation is not Activation.WITHHELD:
            self.activation = activation
