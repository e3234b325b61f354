"""Draws the faults of a stratified campaign in rounds, more in strata whose outcomes have varied.

A stratum is defined by what the seed determines about a fault before any flight. At source level,
this is the highest flipped bit (its field, its half of the field, and its state) and the moment, if
that is random. At instruction level, it is the node and the moment. Every repetition has a pool of
seeds. On average, a stratum has the same share of the pools as of the population, whatever rule
derives a fault from its seed. A round allocates a number of missions to each stratum, and a seed
from a pool to each mission. A mission's weight is the number of uniformly drawn missions that it
represents, so that the allocation does not bias estimates.

The missions of a round are drawn after all earlier missions have ended, from their results and the
campaign's seed. So a resumed campaign draws the same faults, regardless of the order in which
missions end.
"""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from mavfi_cli.campaigns.ledger import Drawn, Ledger
from mavfi_cli.campaigns.missions import (
    COUNTED,
    MissingMission,
    PlannedMission,
    changes_of,
    kind_of,
)
from mavfi_cli.core.config import structure
from mavfi_cli.core.seeds import Stream
from mavfi_cli.fi.bits import NUMPY_TYPES, BitType, Field
from mavfi_cli.fi.fault import When
from mavfi_cli.fi.injector import rehearsed
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.strata import allocate, rounded, spread

T = TypeVar("T")
ROUND = 25  # repetitions of a round without a stopping rule; with one, its batch
POOL = 48  # seeds of each repetition from which faults are drawn
_WIDE = 8  # fields with at least this many bits are split into halves
_PLANNER = "planner"
_THIRDS = ("early", "midway", "late")
Stratum = tuple[str, ...]  # from the coarsest part to the finest
Fault = FaultConfig | InstructionConfig


# The stratum of a seed ----------------------------------------------------------------------------


def stratum_of(fault: Fault, requests: int = 0) -> Stratum:
    """Return the finest stratum that contains a fault. The fault's seed determines it.

    Args:
        requests: number of plans that the golden flight requests; 0 if unknown.
    """
    if isinstance(fault, InstructionConfig):
        node = fault.node()
        # The invocation is this number, scaled to the invocations of the golden flight.
        drawn = int(Stream.FAULT.generator(fault.seed, "instruction").integers(1 << 32))
        moment = drawn / (1 << 32)
        if node != _PLANNER:
            return node, _third(moment)
        first = moment * requests < 1.0
        return node, ("first request" if first else "later request") if requests else "any request"
    if fault.attacks_detector or fault.killed_node is not None:
        return ()
    source = fault.draw()
    moment, strike = rehearsed(source, fault.seed)
    parts: list[str] = []
    struck = [(max(change.bits), change.state) for change in strike.changes if change.bits]
    if struck:
        bit, name = max(struck)
        state = next(state for state in source.states if state.name == name)
        parts = [*_part_of(NUMPY_TYPES[state.dtype.value], bit), name]
    return *parts, *([_third(moment)] if source.trigger.when is When.RANDOM else [])


def _third(moment: float) -> str:
    return _THIRDS[int(moment * len(_THIRDS))]


def _part_of(kind: BitType, bit: int) -> tuple[str, str]:
    """Return the field of a bit and its half of that field, such as `exponent`, `upper half`."""
    fields = {own: bits for own, bits in kind.fields.items() if own is not Field.ANY}
    name, bits = next(
        ((own.value, bits) for own, bits in fields.items() if bit in bits),
        ("value", range(kind.width)),
    )
    upper = bit >= bits[len(bits) // 2]
    return name, "whole" if len(bits) < _WIDE else "upper half" if upper else "lower half"


def coarsened(strata: Sequence[Stratum], least: float) -> frozenset[Stratum]:
    """Merge strata, finest level first, until each holds a share of at least `least`.

    Args:
        strata: the finest stratum of each seed, with repetitions.
        least: smallest share of the seeds that a stratum other than the empty one may hold.

    Returns:
        The strata that remain, including the empty one. A seed belongs to the longest of them that
            is a prefix of its own stratum.
    """
    kept: set[Stratum] = {()}
    left = Counter(strata)
    for length in range(max(map(len, strata)), 0, -1):
        for stratum in sorted(own for own in left if len(own) == length):
            if left[stratum] >= least * len(strata):
                kept.add(stratum)
            else:
                left[stratum[:-1]] += left.pop(stratum)
    return frozenset(kept)


def _coarse(stratum: Stratum, kept: frozenset[Stratum]) -> Stratum:
    return next(own for end in range(len(stratum), -1, -1) if (own := stratum[:end]) in kept)


# Rounds -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Strike:
    """One fault on the list, and the missions that have it, with and without detectors.

    Attributes:
        config: one of these missions.
        numbers: numbers of all these missions.
        bare: numbers of those without a detector.
    """

    config: MissionConfig
    numbers: list[int] = field(default_factory=list)
    bare: list[int] = field(default_factory=list)

    @property
    def fault(self) -> Fault:
        fault = self.config.fault or self.config.instruction
        assert fault is not None
        return fault


class Rounds:
    """The rounds in which a stratified campaign draws the faults of its missions.

    Missions with equal faults but different detectors also get equal faults when these are drawn.

    Args:
        ledger: ledger of the campaign, open for writing, with a stored list.
        seed: root of the seeds of all faults.
        size: number of repetitions in a round; the last round has fewer than twice as many.

    Attributes:
        drawn: the faults drawn so far, by mission number.
    """

    def __init__(self, ledger: Ledger, seed: int, size: int = ROUND) -> None:
        self._ledger, self._seed, self._size = ledger, seed, size
        ledger.draw(())
        self.drawn = ledger.draws()
        strikes: dict[str, dict[tuple[MissionConfig, Fault], _Strike]] = {}
        plain: dict[str, list[tuple[int, MissionConfig]]] = {}
        for number, _, _, text in ledger.rows():
            config = structure(json.loads(text), MissionConfig)
            fault = config.fault or config.instruction
            kind = kind_of(changes_of(config), ("seed", "detector"))
            if fault is None:
                plain.setdefault(kind, []).append((number, config))
                continue
            group = strikes.setdefault(kind, {})
            strike = group.setdefault((config.golden, fault), _Strike(config=config))
            strike.numbers.append(number)
            if config.detector is None:
                strike.bare.append(number)
        self._groups = {kind: self._in_rounds([*own.values()]) for kind, own in strikes.items()}
        begins = {  # the round in which a golden flight is first needed
            strike.config.golden: place
            for rounds in self._groups.values()
            for place in range(len(rounds) - 1, -1, -1)
            for strike in rounds[place]
        }
        self._plain: dict[int, list[tuple[int, MissionConfig]]] = {}
        for missions in plain.values():
            for place, part in enumerate(self._in_rounds(missions)):
                for mission in part:
                    first = min(place, begins.get(mission[1].golden, place))
                    self._plain.setdefault(first, []).append(mission)

    def _in_rounds(self, members: Sequence[T]) -> list[Sequence[T]]:
        last = max(1, len(members) // self._size) - 1
        cuts = [*(place * self._size for place in range(last + 1)), len(members)]
        return [members[begin:end] for begin, end in itertools.pairwise(cuts)]

    def missing(self, stopped: Collection[int], *, errors: bool) -> Iterator[MissingMission | None]:
        """Yield the missing missions, and draw each round once all earlier missions have ended.

        Args:
            stopped: numbers of the settings that the stopping rule has ended so far.
            errors: include missions that could not begin.

        Yields:
            The next missing mission; None while an earlier mission has not ended.
        """
        cells = self._ledger.mission_cells()
        begun: list[int] = []
        for number in sorted({*range(max(map(len, self._groups.values()), default=0)),
                              *self._plain}):  # fmt: skip
            for part in self._parts(number):
                while any(cells[mission.number] not in stopped
                          for mission in self._ledger.missing(among=begun)):  # fmt: skip
                    yield None
                if any(strike.numbers[0] in part for strike in self._strikes(number)):
                    self._draw(number)
                yield from self._ledger.missing(errors=errors, among=part)
                begun = part

    def _strikes(self, number: int) -> list[_Strike]:
        return [
            strike
            for rounds in self._groups.values()
            for strike in (rounds[number] if number < len(rounds) else ())
        ]

    def _parts(self, number: int) -> list[list[int]]:
        """Return the numbers of a round's missions in parts that are flown one after another.

        If draws need the results of fault-free missions, these form the first of two parts.
        """
        strikes = self._strikes(number)
        plain = [mission for mission, _ in self._plain.get(number, ())]
        struck = [mission for strike in strikes for mission in strike.numbers]
        first = any(isinstance(strike.fault, InstructionConfig) for strike in strikes)
        parts = [plain, struck] if first else [plain + struck]
        return [sorted(part) for part in parts if part]

    # One round

    def _draw(self, number: int) -> None:
        """Draw and store the faults of a round, unless they are already stored."""
        if any(strike.numbers[0] in self.drawn for strike in self._strikes(number)):
            return
        rows: list[Drawn] = []
        for kind, rounds in self._groups.items():
            if number < len(rounds):
                rows += self._drawn(kind, rounds, number)
        self._ledger.draw(rows)
        self.drawn.update((row.number, row) for row in rows)

    def _drawn(
        self, kind: str, rounds: Sequence[Sequence[_Strike]], number: int
    ) -> Iterator[Drawn]:
        """Yield the faults drawn for the missions of one kind in round `number`."""
        strikes = rounds[number]
        first = [stratum for pool in self._pools(kind, rounds, 0) for _, stratum in pool]
        kept = coarsened(first, 2.0 / len(rounds[0]))
        pools = [
            [(seed, _coarse(stratum, kept)) for seed, stratum in pool]
            for pool in self._pools(kind, rounds, number)
        ]
        strata = sorted({stratum for pool in pools for _, stratum in pool})
        sizes = [[sum(own == stratum for _, own in pool) / POOL for stratum in strata]
                 for pool in pools]  # fmt: skip
        totals = [math.fsum(column) for column in zip(*sizes, strict=True)]
        spreads = self._spreads(rounds[:number])
        counts = allocate(
            [total / len(pools) for total in totals],
            [spreads.get(_text(stratum), spread(0, 0)) for stratum in strata],
            len(pools),
        )
        rng = Stream.FAULT.generator(self._seed, "rounds", kind, number)
        expected = [
            [count * size / total for size, count, total in zip(row, counts, totals, strict=True)]
            for row in sizes
        ]
        chosen: list[list[tuple[int, Stratum, float]]] = []
        for pool, numbers in zip(pools, rounded(expected, rng), strict=True):
            chosen.append([])
            for stratum, wanted, count, total in zip(strata, numbers, counts, totals, strict=True):
                seeds = [seed for seed, own in pool if own == stratum]
                picked = rng.choice(len(seeds), size=wanted, replace=wanted > len(seeds))
                chosen[-1] += [(seeds[place], stratum, total / count) for place in picked]
        # A strike whose own repetition got no draw moves to a repetition that got several.
        further = [(strike, *draw) for strike, draws in zip(strikes, chosen, strict=True)
                   for draw in draws[1:]]  # fmt: skip
        for strike, draws in zip(strikes, chosen, strict=True):
            place, seed, stratum, weight = (strike, *draws[0]) if draws else further.pop(0)
            yield from self._rows(strike, number, place, seed, _text(stratum), weight)

    def _rows(
        self, strike: _Strike, number: int, place: _Strike, seed: int, stratum: str, weight: float
    ) -> Iterator[Drawn]:
        """Yield the draw of each mission of a strike.

        Args:
            place: the strike whose mission seed the missions get.
            seed: seed of the fault that they get.
        """
        for mission, config in zip(
            strike.numbers, self._ledger.configs(strike.numbers), strict=True
        ):
            level = "fault" if config.fault is not None else "instruction"
            fault: Any = replace(strike.fault, seed=seed)
            moved: Any = {"seed": place.config.seed, level: fault}
            _, pair, changes = PlannedMission(config=replace(config, **moved)).stored
            yield Drawn(mission, number, stratum, weight, pair, changes)

    def _pools(
        self, kind: str, rounds: Sequence[Sequence[_Strike]], number: int
    ) -> list[list[tuple[int, Stratum]]]:
        """Return a pool for each strike in a round: its possible seeds, each with its stratum."""
        requests = self._requests(rounds[number])
        begin = sum(map(len, rounds[:number]))
        pools = []
        for place, strike in enumerate(rounds[number], start=begin):
            seeds = [
                Stream.FAULT.seed(self._seed, "pool", kind, place, draw) for draw in range(POOL)
            ]
            plans = requests.get(strike.config.golden, 0)
            pools.append([(seed, stratum_of(replace(strike.fault, seed=seed), plans))
                          for seed in seeds])  # fmt: skip
        return pools

    def _requests(self, strikes: Sequence[_Strike]) -> dict[MissionConfig, int]:
        """Return the number of plans requested in each of the strikes' golden flights, if known."""
        wanted = {strike.config.golden for strike in strikes
                  if isinstance(strike.fault, InstructionConfig)}  # fmt: skip
        numbers = [
            mission
            for missions in self._plain.values()
            for mission, config in missions
            if config in wanted  # excludes missions with a detector
        ]
        requests: dict[MissionConfig, int] = {}
        for result in self._ledger.results(numbers):
            planner = result.flight.kernels.get(_PLANNER)
            requests[result.mission.config] = 0 if planner is None else planner.invocations
        return requests

    def _spreads(self, rounds: Sequence[Sequence[_Strike]]) -> dict[str, float]:
        """Return the standard deviation of a mission's failure, 1 or 0, in each stratum.

        Missions with a detector count only for strikes that have no mission without one.
        """
        over = dict(self._ledger.fates())
        lost: dict[str, list[bool]] = {}
        for strike in itertools.chain.from_iterable(rounds):
            for mission in strike.bare or strike.numbers:
                if mission in over:
                    outcome, fate = over[mission]
                    stratum = self.drawn[mission].stratum
                    lost.setdefault(stratum, []).append(outcome != "success" and fate in COUNTED)
        return {stratum: spread(sum(own), len(own)) for stratum, own in lost.items()}


def _text(stratum: Stratum) -> str:
    return ", ".join(stratum) or "other"
