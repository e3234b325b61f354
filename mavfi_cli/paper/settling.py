"""Settles claims: flies missions for undecided claims until all are decided or time runs out.

Every look judges all claims again, with tests that are valid at any look (`stats.sequences`). The
next missions go to the claim that would be decided soonest if its effect stayed the same.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import pyarrow as pa

from mavfi_cli.analysis.flights import SETTLING, flights
from mavfi_cli.analysis.kernels import KERNELS, IsolatedKernel, KernelSummary
from mavfi_cli.analysis.pairs import Fate, Flights
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission, changes_of, kind_of
from mavfi_cli.campaigns.progress import Spectator, duration
from mavfi_cli.campaigns.run import Options, fly_missing, store_plan
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.paper.claims import judged
from mavfi_cli.paper.items import BY_NAME, KERNELS_FOLDER, FlightsPlan, Source, key_of
from mavfi_cli.paper.verdicts import Claim, FirstLook, Judgement, SettledClaim, Settling, Verdict

BATCH = 10  # maximum number of repetitions between two looks
_MOST = 100_000  # maximum number of repetitions of a claim's missions
_SEARCHED = 100  # repetitions planned and searched at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class _OpenClaim:
    """An undecided claim, and the missions that would decide it.

    Attributes:
        judgement: its judgement at the last look.
        kinds: kinds of missions on which its effect depends.
        missions, seconds: number of further missions that would decide the claim if its effect
            stayed the same, and their wall time in seconds; infinite if no number would decide it.
        repetition_s: wall time of one more repetition of missions of these kinds, in seconds.
    """

    claim: Claim
    judgement: Judgement
    kinds: frozenset[str]
    missions: float
    seconds: float
    repetition_s: float

    @property
    def summary(self) -> str:
        """The number of missions that would decide the claim, and their wall time, in one line."""
        if math.isinf(self.missions):
            return f"{self.claim.name}: no number of missions decides it, if the effect stays"
        return (
            f"{self.claim.name}: {self.missions:,.0f} missions, about {duration(self.seconds)}, "
            "if the effect stays"
        )


def require_settleable(plan: FlightsPlan) -> None:
    """Check that missions can be added to the campaign of a plan.

    Raises:
        ConfigError: no item of the plan flies missions, or the plan's path is an export.
    """
    if plan.out.suffix == ".parquet" or plan.folder.is_file():
        raise ConfigError(
            "cannot add missions to an export; use the folder of the reproduction", path=plan.out
        )
    if not any(item.source is Source.FLIGHTS for item in plan.items):
        names = ", ".join(item.name for item in plan.items)
        raise ConfigError(
            f"at least one of the selected items must fly missions, but got only {names}",
            key="settle",
        )


def settle(
    plan: FlightsPlan,
    ledger: Ledger,
    options: Options,
    spectator: Spectator,
    hours: float | None,
) -> list[str]:
    """Fly missions until the claims of the items are decided, or time runs out.

    Args:
        plan: a plan whose missions have been flown.
        ledger: the plan's ledger, open for writing.
        hours: limit on the wall time, in hours; None means no limit.

    Returns:
        A line for each claim that was decided by added missions, with its verdict, and one for each
        claim that is still undecided.

    Raises:
        MavfiError: a mission cannot be flown.
    """
    begun, limit_s = time.monotonic(), math.inf if hours is None else 3600.0 * hours
    jobs = options.jobs or len(os.sched_getaffinity(0))
    look = _Look(plan, jobs)
    settling = Settling.of(ledger.meta(SETTLING)) or Settling(first=look.first(ledger))
    before: dict[str, _OpenClaim] = {}
    looked, lines = False, list[str]()
    while True:
        still = look.open_claims(ledger, settling)
        settling = _stored(ledger, settling, look)
        if not looked:
            for line in _cost(still, limit_s):
                spectator.on_note(line)
        looked = True
        for line in _decided(before, look.judgements):
            spectator.on_note(line)
            lines.append(line)
        before = {entry.claim.name: entry for entry in still}
        left_s = limit_s - (time.monotonic() - begun)
        flyable = [
            entry
            for entry in still
            if entry.kinds and entry.repetition_s <= left_s and not entry.judgement.without_size
        ]
        if not flyable:
            break
        chosen = min(flyable, key=lambda entry: (entry.seconds, entry.repetition_s))
        repetitions = int(min(BATCH, max(1.0, left_s / max(chosen.repetition_s, 1e-9))))
        since = time.monotonic()
        flown = _fly(plan, ledger, chosen, repetitions, options, spectator)
        name, seconds = chosen.claim.name, time.monotonic() - since
        own = settling.claims.get(name, SettledClaim())
        own = replace(own, looks=own.looks + 1, missions=own.missions + flown,
                      seconds=own.seconds + seconds)  # fmt: skip
        claims = {**settling.claims, name: own}
        settling = replace(settling, looks=settling.looks + 1, claims=claims)
    return [*lines, *map(_undecided, still)]


def _stored(ledger: Ledger, settling: Settling, look: _Look) -> Settling:
    """Add the latest verdicts to `settling`, store it in the ledger, and return it."""
    claims = {
        name: replace(own, verdict=look.judgements[name].verdict.value)
        for name, own in settling.claims.items()
        if name in look.judgements
    }
    settling = replace(settling, claims={**settling.claims, **claims})
    ledger.set_meta({SETTLING: settling.to_json()})
    return settling


class _Look:
    """Judges the claims of a plan's items, and finds the missions that would decide them.

    Attributes:
        judgements: judgement at the last look, by name of the claim.
    """

    def __init__(self, plan: FlightsPlan, jobs: int) -> None:
        self._plan, self._jobs = plan, jobs
        self._kinds: dict[str, frozenset[str]] = {}
        self.judgements: dict[str, Judgement] = {}
        path = plan.out / KERNELS_FOLDER / KERNELS
        summary = KernelSummary.read(path).kernels if path.is_file() else ()
        self._kernels = {kernel.name: kernel for kernel in summary}

    def first(self, ledger: Ledger) -> dict[str, dict[str, FirstLook]]:
        """Return the first look at every claim that has an effect, keyed by claim name and fate."""
        place = self._plan.regime.name
        return {
            entry.claim.name: {
                fate.value: FirstLook(
                    p=own.p_alone,
                    inside=entry.claim.low <= own.effect.value <= entry.claim.high,
                )
                for fate, own in entry.judgements.get(place, {}).items()
                if own.effect is not None
            }
            for entry in judged({place: self._flown(flights(ledger))}, self._kernels)
        }

    def _flown(self, table: pa.Table) -> Flights:
        """Select the flights of the plan's stack that claims use."""
        whole = Flights.of(table)
        return whole.chosen(stack=self._plan.stack, as_paper=True, at=(None, "random"))

    def open_claims(self, ledger: Ledger, settling: Settling) -> list[_OpenClaim]:
        """Judge all claims again. Return those of the plan's items that are undecided.

        Claims of items that fly no missions are left out.
        """
        place = self._plan.regime.name
        table = flights(ledger)
        flown = self._flown(table)
        verdicts = judged({place: flown}, self._kernels, {place: settling})
        names = {item.name for item in self._plan.items}
        own = [
            (entry.claim, entry.judgements[place][Fate.ALL])
            for entry in verdicts
            if entry.claim.item in names and place in entry.judgements
        ]
        self.judgements = {claim.name: judgement for claim, judgement in own}
        rows = zip(table["changes"].to_pylist(), table["wall_s"].to_pylist(), strict=True)
        walls: dict[str, list[float]] = {}
        for changes, wall_s in rows:
            walls.setdefault(_kind(changes), []).append(wall_s)
        return [
            self._open(claim, judgement, flown, walls)
            for claim, judgement in own
            if judgement.verdict is Verdict.UNDECIDED and BY_NAME[claim.item].preset
        ]

    def _open(
        self, claim: Claim, judgement: Judgement, flown: Flights,
        walls: Mapping[str, Sequence[float]],
    ) -> _OpenClaim:  # fmt: skip
        planned = [_kind_of(mission) for mission in self._plan.kinds(BY_NAME[claim.item])]
        if claim.name not in self._kinds:
            self._kinds[claim.name] = _counted_kinds(claim, flown, planned, self._kernels)
        kinds = self._kinds[claim.name]
        assert judgement.effect is not None
        missions = Counter(planned)
        repetition_s = math.fsum(
            missions[kind] * fmean(walls.get(kind) or [0.0]) / self._jobs for kind in kinds
        )
        flown_missions = sum(len(walls.get(kind, ())) for kind in kinds)
        share = judgement.needed / judgement.effect.count - 1.0
        more = max(1.0, share * flown_missions) if kinds else math.inf
        one = sum(missions[kind] for kind in kinds) or 1
        return _OpenClaim(
            claim=claim, judgement=judgement, kinds=kinds, missions=more,
            seconds=more / one * repetition_s if kinds else math.inf, repetition_s=repetition_s,
        )  # fmt: skip


def _kind_of(mission: PlannedMission) -> str:
    return kind_of(changes_of(mission.config), ("seed",))


def _kind(changes: str) -> str:
    return kind_of(json.loads(changes), ("seed",))


def _counted_kinds(
    claim: Claim,
    flown: Flights,
    planned: Iterable[str],
    kernels: Mapping[str, IsolatedKernel],
) -> frozenset[str]:
    """Return the planned kinds of missions on which a claim's effect depends.

    A kind is included if leaving out its flights changes the effect.
    """
    kinds = [_kind(changes) for changes in flown["changes"]]
    whole = claim.find(flown, kernels)
    return frozenset(
        kind
        for kind in set(planned).intersection(kinds)
        if claim.find(flown.without(own == kind for own in kinds), kernels) != whole
    )


def _fly(
    plan: FlightsPlan,
    ledger: Ledger,
    entry: _OpenClaim,
    repetitions: int,
    options: Options,
    spectator: Spectator,
) -> int:
    """Fly further repetitions of a claim's missions, and return the number of their missions."""
    over = {number for number, _ in ledger.fates()}
    flown = {changes for number, _, _, changes in ledger.rows() if number in over}
    first = _first_missing(plan, entry, flown)
    wanted = [
        mission
        for mission, _ in plan.numbered(BY_NAME[entry.claim.item], first, first + repetitions)
        if _kind_of(mission) in entry.kinds and key_of(mission) not in flown
    ]
    store_plan(ledger, wanted, append=True)
    keys = {key_of(mission) for mission in wanted}
    numbers = frozenset(n for n, _, _, changes in ledger.rows() if changes in keys)
    fly_missing(ledger, replace(options, only=numbers, planned=numbers), spectator)
    return len(numbers)


def _first_missing(plan: FlightsPlan, entry: _OpenClaim, flown: Collection[str]) -> int:
    """Return the first repetition that lacks a mission of the claim, or _MOST if there is none."""
    item = BY_NAME[entry.claim.item]
    for first in range(0, _MOST, _SEARCHED):
        for mission, repetition in plan.numbered(item, first, first + _SEARCHED):
            if _kind_of(mission) in entry.kinds and key_of(mission) not in flown:
                return repetition
    return _MOST


# Words --------------------------------------------------------------------------------------------


def _cost(still: Sequence[_OpenClaim], limit_s: float) -> list[str]:
    """Return lines on the wall time needed to decide the open claims if all effects stay equal."""
    if not still:
        return ["every claim that missions can decide is decided"]
    some = [entry for entry in still if not math.isinf(entry.seconds)]
    lines = [f"{len(still)} claims are undecided:", *(f"  {entry.summary}" for entry in still)]
    whole = sum(entry.seconds for entry in some)
    given = "no limit" if math.isinf(limit_s) else f"at most {duration(limit_s)}"
    lines.append(
        f"at most {duration(whole)} for {len(some)} of them on this machine; {given} is given"
    )
    return lines


def _decided(before: Mapping[str, _OpenClaim], now: Mapping[str, Judgement]) -> list[str]:
    return [
        f"{name}: {now[name].verdict.value}{_bounds(entry.claim, now[name])}"
        for name, entry in before.items()
        if now[name].verdict is not Verdict.UNDECIDED
    ]


def _undecided(entry: _OpenClaim) -> str:
    return f"{entry.claim.name}: cannot tell{_bounds(entry.claim, entry.judgement)}"


def _bounds(claim: Claim, judgement: Judgement) -> str:
    """Return words for the bounds of an effect, or for the reason why it has none.

    They also state whether the bounds exclude an effect of the claim's size.
    """
    effect, bounds = judgement.effect, judgement.bounds
    if effect is None or bounds is None:
        return f" ({judgement.why})"
    scale, unit = (1.0, "") if claim.unit == "number" else (100.0, f" {claim.unit}")
    low, high = (f"{scale * end:.3g}" for end in (bounds.low, bounds.high))
    size = "; no effect of the claim's size" if judgement.without_size else ""
    return f"; with n = {effect.count:,} the effect lies between {low} and {high}{unit}{size}"
