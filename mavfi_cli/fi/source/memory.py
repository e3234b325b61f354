"""Faults in a program's memory: an element of one of several named arrays.

They attack a detector's memory (thresholds, means, weights): a detector can be hit as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import FaultSpecError, UnknownName
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.fi import bits as bit_operations
from mavfi_cli.fi.source.fault import Corruption, Effect, Trigger
from mavfi_cli.fi.source.injector import MAX_LISTED_STRIKES, Change, Strike, change_of
from mavfi_cli.fi.source.schedule import Moment, Pattern, Schedule

Memory = Mapping[str, NDArray[Any]]


class MemoryInjector:
    """Carries one fault in a memory through one mission.

    Args:
        memory: the arrays, which are changed in place.
        array: the attacked array; None draws one in proportion to its bits.
        trigger: when to strike; an invocation is a control tick.
        bits: the exact bits; None draws them.
        seed: root of the fault's random stream.
        shortest_flight_s: a random time is drawn over this time, s.
        listener: called with every strike.

    Attributes:
        array, element: the attacked array, and the index of the element in C order.
        strikes, count: as in `SourceInjector`.

    Raises:
        UnknownName: there is no such array.
        BitOutsideWidth, FieldUnavailable: the array's elements do not have these bits.
        FaultSpecError: the array has no elements.
    """

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
        listener: Callable[[Strike], None],
    ) -> None:
        if array is not None and array not in memory:
            raise UnknownName("part of the detector's memory", array, memory)
        rng = generator(seed, Stream.FAULT, "memory")
        self.drawn_time_s = float(rng.uniform(0.0, shortest_flight_s))
        names = sorted(memory)
        if array is None:
            sizes = np.array([memory[name].nbytes for name in names], dtype=np.float64)
            array = names[int(rng.choice(len(names), p=sizes / sizes.sum()))]
        if memory[array].size == 0:
            raise FaultSpecError(f"{array} has no elements")
        self.array = array
        self.element = int(rng.integers(memory[array].size))
        self._kind = bit_operations.NUMPY_TYPES[memory[array].dtype.name]
        if bits is not None:
            bit_operations.mask_of(bits, self._kind)
        elif corruption.effect is Effect.FLIP:
            self._kind.field_bits(corruption.field)
        self._memory = memory
        self._schedule = Schedule(trigger, corruption, self.drawn_time_s)
        chosen = None if bits is None else tuple(sorted(bits))
        self._pattern = Pattern(corruption, rng, chosen)
        self._listener = listener
        self.strikes: list[Strike] = []
        self.count = 0

    def watch(self, moment: Moment) -> None:
        """Note the mission's present state, once a control tick and for every report."""
        self._schedule.watch(moment)

    @property
    def missed(self) -> str:
        """The reason if the fault never struck."""
        return self._schedule.missed("control tick")

    def strike(self, moment: Moment) -> None:
        """Strike the memory if the fault is due."""
        if not self._schedule.due(moment, moment.tick):
            return
        self._schedule.acted(moment)
        place = self._memory[self.array]
        before = place.flat[self.element].item()
        change: Change = change_of(self.array, self.element, before, self._kind, self._pattern)
        place.flat[self.element] = change.after
        strike = Strike(
            stamp_s=moment.stamp_s,
            tick=moment.tick,
            phase=moment.phase,
            invocation=moment.tick,
            changes=(change,),
        )
        self.count += 1
        if len(self.strikes) < MAX_LISTED_STRIKES:
            self.strikes.append(strike)
        self._listener(strike)
