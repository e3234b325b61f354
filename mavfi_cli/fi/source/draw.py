"""Resolves a requested fault to one exact fault: names are looked up, the rest is drawn by seed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mavfi_cli.core.errors import FaultSpecError, UnknownName
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.states import BY_NAME, State, of_stage
from mavfi_cli.core.types import Stage
from mavfi_cli.fi.bits import NUMPY_TYPES, Field, mask_of
from mavfi_cli.fi.source.fault import Corruption, Effect, SourceFault, Trigger

GROUPS = tuple(dict.fromkeys(state.group for state in BY_NAME.values()))


def draw_fault(
    target: str,
    *,
    seed: int,
    trigger: Trigger,
    corruption: Corruption,
    together: bool = False,
    bits: Sequence[int] | None = None,
) -> SourceFault:
    """Draw the fault of a target and a seed.

    Args:
        target: a stage, a state, or a group of states. Of a stage, one state that has the
            corruption's field is drawn. Of a group, one state is drawn, unless `together`.
        seed: root of the fault's own random stream.
        together: strike all states of the target's group at once, as the paper's Table III does
            with the three components of the acceleration.
        bits: exact bits, the same for each state; None draws them at the strike.

    Raises:
        UnknownName: no such stage, state or group.
        FaultSpecError: a bit outside the width, a field that the type does not have.
    """
    rng = generator(seed, Stream.FAULT, "site")
    states = _states(target, rng, together, corruption.field)
    for state in states:
        kind = NUMPY_TYPES[state.dtype.value]
        if bits is not None:
            mask_of(bits, kind)
        elif corruption.effect is Effect.FLIP and corruption.bits > len(
            kind.field_bits(corruption.field)
        ):
            raise FaultSpecError(
                f"{state.name} is {kind.name}: its field {corruption.field.value} has no "
                f"{corruption.bits} bits"
            )
    chosen = None if bits is None else tuple(tuple(sorted(bits)) for _ in states)
    return SourceFault(states=states, trigger=trigger, corruption=corruption, bits=chosen)


def _states(
    target: str, rng: np.random.Generator, together: bool, field: Field
) -> tuple[State, ...]:
    stages = {stage.value: stage for stage in Stage}
    if target in BY_NAME:
        candidates: tuple[State, ...] = (BY_NAME[target],)
    elif target in GROUPS:
        candidates = _group(target)
    elif target in stages:
        whole = of_stage(stages[target])
        has = [state for state in whole if field in NUMPY_TYPES[state.dtype.value].fields]
        candidates = tuple(has) or whole
    else:
        raise UnknownName("stage, state or group", target, {*stages, *BY_NAME, *GROUPS})
    state = candidates[int(rng.integers(len(candidates)))]
    return _group(state.group) if together else (state,)


def _group(name: str) -> tuple[State, ...]:
    return tuple(state for state in BY_NAME.values() if state.group == name)
