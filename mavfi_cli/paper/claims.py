"""Every claim of the paper: its words, the number that decides it, and what the paper's n can tell.

claims.toml has the claims. A claim is decided by one number, its effect, and by the range that the
claim gives for it; `ClaimVerdict.of` does the rest. A measure finds the effect: it takes a
stack's flights, and the values of columns that choose some of
them. Of faults without a detector it counts those that flipped a bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.analysis.failures import outcome_share
from mavfi_cli.analysis.flights import COSTS
from mavfi_cli.analysis.pairs import EVERY_STAGE, STAGES, Flights
from mavfi_cli.analysis.summary import RESAMPLES
from mavfi_cli.core.config import read_toml
from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.paired import (
    ClaimVerdict,
    Count,
    McNemar,
    correlation,
    recovered_share,
)
from mavfi_cli.stats.shares import Interval, Share, wilson

Where = Mapping[str, Any]  # values of columns; a tuple allows several
Kernels = Mapping[str, Mapping[str, Any]]  # kernel -> its part of kernels.json
ISOLATED = "isolated kernels"
_FEWEST = 4  # flights for a correlation with an interval
_FILE = Path(__file__).parent / "claims.toml"
_AS_PRINTED = "paper"  # an end of the range that the paper's own interval has


@dataclass(frozen=True, slots=True, kw_only=True)
class _Finding:
    """What our missions say about a claim.

    Attributes:
        effect: None if no mission tells.
        told: the counts behind it.
    """

    effect: Interval | None = None
    told: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Claim:
    """A claim of the paper, as claims.toml explains.

    Attributes:
        item: table or figure, by its name in `mavfi reproduce`.
        find: the effect of a stack's flights, or of the isolated kernels.
    """

    name: str
    item: str
    words: str
    effect: str
    find: Callable[[Any], _Finding]
    paper: str = "no number printed"
    low: float = -math.inf
    high: float = math.inf
    unit: str = "points"
    paper_tells: str = "drawn only, without counts"
    isolated: bool = False

    def judged(self, flights: Mapping[str, Flights], kernels: Kernels) -> dict[str, Any]:
        """The claim as plain values, with its verdict on each stack.

        Args:
            flights: of each stack.
        """
        sources = {ISOLATED: kernels} if self.isolated else flights
        cells = {name: self._cell(self.find(source)) for name, source in sources.items()}
        return {**{x: getattr(self, x) for x in self.__slots__ if x != "find"}, "cells": cells}

    def _cell(self, found: _Finding) -> dict[str, Any]:
        verdict = ClaimVerdict.of(found.effect, self.low, self.high)
        if verdict is ClaimVerdict.NOT_FLOWN and found.told:
            verdict = ClaimVerdict.NOT_JUDGED
        known = found.effect is not None and not math.isnan(found.effect.low)
        return {"verdict": verdict, "effect": found.effect if known else None, "told": found.told}


def _of_share(found: Share, what: str) -> _Finding:
    if not found.total:
        return _Finding()
    return _Finding(effect=found.effect, told=f"{found.counts} {what}")


def _difference(shares: Sequence[Share], told: str) -> _Finding:
    """The first minus the second of two shares; nothing unless both have flights."""
    first, second = shares
    if not (first.total and second.total):
        return _Finding()
    return _Finding(effect=first.minus(second), told=told)


# Faults without a detector ------------------------------------------------------------------------


def _success_lost(flights: Flights, **where: Any) -> _Finding:
    """Success of the golden flights minus that of the same missions with a fault."""
    both = flights.struck(**where).chosen(own_lost=(True, False))
    if not len(both):
        return _Finding()
    found = McNemar.of(~both.flags("lost"), ~both.flags("own_lost")).effect
    told = f"{both.share().counts} lost; golden {both.share('own_lost').counts}"
    return _Finding(effect=found, told=told)


def _most_lost_kernel(flights: Flights, **where: Any) -> _Finding:
    """Success lost by faults in the kernel that loses most."""
    hit = flights.struck(**where).by("struck_kernel")
    kernels = {name: those.share().share for (name,), those in hit.items() if name}
    if not kernels:
        return _Finding()
    most = max(kernels, key=lambda name: kernels[name])
    found = _success_lost(flights, **where, struck_kernel=most)
    return _Finding(effect=found.effect, told=f"most in {most}: {found.told}")


def _harm_difference(flights: Flights, groups: Mapping[str, Where]) -> _Finding:
    """Share of harmful faults in the first of two groups minus that in the second."""
    shares = [flights.struck(**where).share("harmed") for where in groups.values()]
    told = (f"{name} {each.counts}" for name, each in zip(groups, shares, strict=True))
    return _difference(shares, f"harmful: {'; '.join(told)}")


def _harmful(flights: Flights, **where: Any) -> _Finding:
    return _of_share(flights.struck(**where).share("harmed"), "harmful")


def _loss_difference(
    flights: Flights, first: Where, second: Where, told: str, **where: Any
) -> _Finding:
    """Share of lost missions in one group of faults minus that in another.

    Args:
        told: the counts, as a format of two texts.
    """
    shares = [flights.struck(**where, **each).share() for each in (first, second)]
    return _difference(shares, f"lost: {told.format(*(each.counts for each in shares))}")


def _as_long(flights: Flights, ratio: float, **where: Any) -> _Finding:
    return _of_share(_at_least(ratio, flights.struck(**where).ratios), "as long")


def _at_least(ratio: float, found: FloatArray) -> Share:
    return wilson(int((found >= ratio).sum()), len(found))


def _worst_as_long(flights: Flights, ratio: float, missions: int, **where: Any) -> _Finding:
    """The probability that the longest of so many flights reaches a ratio to its golden flight."""
    found = flights.struck(**where).ratios
    if not len(found):
        return _Finding()
    beyond = _at_least(ratio, found)
    longest = 100.0 * (found.max() - 1.0)
    return _Finding(
        effect=beyond.longest_reaches(missions),
        told=f"{beyond.counts} as long; longest {longest:+.1f} %",
    )


def _energy_follows_time(flights: Flights, **where: Any) -> _Finding:
    """Correlation of energy with flight time over successful golden flights."""
    won = flights.golden.chosen(lost=False, **where)
    pairs = np.stack([won.numbers(name) for name in ("flight_time_s", "energy_regression_j")], 1)
    pairs = pairs[(pairs > 0.0).all(axis=1)]
    if len(pairs) < _FEWEST:
        return _Finding()
    return _Finding(effect=correlation(pairs.tolist()), told=f"{len(pairs):,} golden flights")


# The same faults without and with a detector ------------------------------------------------------


def _recovered(flights: Flights, detector: str, **where: Any) -> _Finding:
    """The share of lost missions that a detector saves."""
    seen = flights.protected(detector, **where)
    lost = seen.chosen(bare_lost=True)
    return _of_some(lost, "lost", "lost missions saved") or _none_of(seen, "lost")


def _shortened(flights: Flights, detector: str, **where: Any) -> _Finding:
    """The share of longer flights that a detector brings back within 5 %."""
    seen = flights.protected(detector, **where)
    longer = seen.chosen(bare_lost=False, bare_harmed=True)
    told = "longer flights brought back"
    return _of_some(longer, "harmed", told) or _none_of(seen, "over 5 % longer")


def _of_some(flights: Flights, column: str, told: str) -> _Finding | None:
    return _of_share(flights.share(column, value=False), told) if len(flights) else None


def _none_of(seen: Flights, what: str) -> _Finding:
    """What is told if none of the faults, flown without the detector, had an effect."""
    return _Finding(told=f"without it 0 of {len(seen):,} {what}") if len(seen) else _Finding()


def _undone(flights: Flights, detector: str, protect: str, where: Where) -> Share:
    """The share of harmful faults that do no harm with a detector of these stages."""
    seen = flights.protected(detector, protect, **where)
    return seen.chosen(bare_harmed=True).share("harmed", value=False)


def _control_recovers_most(flights: Flights, detector: str, **where: Any) -> _Finding:
    """Harm undone by watching control minus that by the better single other stage."""
    shares = {stage: _undone(flights, detector, stage, where) for stage in STAGES}
    if not all(each.total for each in shares.values()):
        return _Finding()
    *others, control = shares.values()
    told = ", ".join(f"{name} {each.counts}" for name, each in shares.items())
    best = max(others, key=lambda each: each.share)
    return _difference((control, best), f"harm undone: {told}")


def _all_stages_best(flights: Flights, detector: str, **where: Any) -> _Finding:
    """Harm undone by watching all stages minus that by watching control."""
    shares = [_undone(flights, detector, each, where) for each in (EVERY_STAGE, "control")]
    told = "harm undone: all stages {}, control {}".format(*(each.counts for each in shares))
    return _difference(shares, told)


def _autoencoder_better(flights: Flights, **where: Any) -> _Finding:
    """Success with the autoencoder minus success with the Gaussian detector."""
    seen = [flights.protected(name, **where) for name in ("gad", "aad")]
    gad, aad = (dict(zip(x.faults, ~x.flags("lost"), strict=True)) for x in seen)
    both = sorted(gad.keys() & aad.keys())
    if not both:
        return _Finding()
    test = McNemar.of([gad[key] for key in both], [aad[key] for key in both])
    told = f"{test.only_second} missions by AAD only, {test.only_first} by GAD only"
    return _Finding(effect=test.effect, told=f"{told}, of {test.pairs:,}")


# Costs of detectors -------------------------------------------------------------------------------

_NO_COSTS = _Finding(told="flown, but this export does not hold these times; a new one does")


def _overhead_of(flights: Flights, detector: str, **where: Any) -> _Finding:
    """The mean share of the flight time that detection and recovery take."""
    seen, shares = _overheads(flights, detector, where)
    told = "time of the computer that flew, and simulated recovery"
    return _mean_cost(seen, shares, told)


def _gaussian_dearer(flights: Flights, **where: Any) -> _Finding:
    """Overhead of the Gaussian detector minus that of the autoencoder, on the same faults."""
    gad, aad = (
        dict(zip(*_overheads(flights, name, where), strict=True)) for name in ("gad", "aad")
    )
    both = sorted(gad.keys() & aad.keys())
    more = [gad[key] - aad[key] for key in both]
    return _mean_cost(both, more, "the same faults with either detector")


def _overheads(
    flights: Flights, detector: str, where: Where
) -> tuple[list[tuple[str, str]], list[float]]:
    """The faults with a detector, and its share of each flight time; NaN if unknown."""
    seen = flights.struck(detector=detector, protect=EVERY_STAGE, **where)
    return seen.faults, np.sum([seen.numbers(name) for name in COSTS], axis=0).tolist()


def _mean_cost(seen: Collection[Any], costs: Sequence[float], told: str) -> _Finding:
    known = [each for each in costs if not math.isnan(each)]
    if not known:
        return _NO_COSTS if seen else _Finding()
    return _Finding(effect=interval(known, resamples=RESAMPLES), told=told)


def _calibrated(_: Flights) -> _Finding:
    """No finding: the model takes this number from the paper."""
    return _Finding(told="our model is calibrated with this number, so it tells nothing")


# Isolated kernels ---------------------------------------------------------------------------------


def _outcome_beside(
    kernels: Kernels, kernel: str, outcome: str, extreme: str, others: Sequence[str] = ()
) -> _Finding:
    """The share of an outcome in one kernel minus that in the most extreme of others.

    Args:
        extreme: `most` or `least`.
        others: none mean all.
    """
    there = [each for each in others or kernels if each in kernels and each != kernel]
    if kernel not in kernels or not there:
        return _Finding()
    choose = max if extreme == "most" else min
    other = choose(there, key=lambda each: outcome_share(kernels[each], outcome).share)
    shares = {each: outcome_share(kernels[each], outcome) for each in (kernel, other)}
    told = (f"{kernels[each]['title']} {100 * found.share:.1f} %" for each, found in shares.items())
    effect = shares[kernel].minus(shares[other])
    return _Finding(effect=effect, told=", ".join(told))


def _least_benign(kernels: Kernels, but: str) -> _Finding:
    """The least share of benign runs of all kernels but one."""
    shares = {each: outcome_share(kernels[each], "benign") for each in kernels if each != but}
    if not shares:
        return _Finding()
    least = min(shares, key=lambda each: shares[each].share)
    told = f"least: {kernels[least]['title']}, {shares[least].counts}"
    return _Finding(effect=shares[least].effect, told=told)


MEASURES: Mapping[str, Callable[..., _Finding]] = {measure.__name__[1:]: measure for measure in (
    _success_lost, _most_lost_kernel, _harm_difference, _harmful, _loss_difference, _as_long,
    _worst_as_long, _energy_follows_time, _recovered, _shortened, _control_recovers_most,
    _all_stages_best, _autoencoder_better, _overhead_of, _gaussian_dearer, _calibrated,
    _outcome_beside, _least_benign,
)}  # fmt: skip
"""By the names that claims.toml uses. Each takes flights or kernels, and what a claim gives it."""

# The claims of claims.toml ------------------------------------------------------------------------


def _read(path: Path) -> Iterator[_Claim]:
    data, _ = read_toml(path)
    for told in data["claim"]:
        measure, given = told.pop("measure"), told.pop("given", {})
        counts = [(wins, missions) for wins, missions in told.pop("paper_counts", ())]
        if counts:
            told |= _in_the_paper(told, counts)
        yield _Claim(
            item=told["name"].partition("-")[0],
            find=partial(MEASURES[measure], **_arguments(given, data["flights"])),
            **told,
        )


def _in_the_paper(told: Mapping[str, Any], counts: Sequence[Count]) -> dict[str, Any]:
    from scipy.stats import fisher_exact

    spread = _spread(counts)
    ends = {end: getattr(spread, end) for end in ("low", "high")}
    chance = fisher_exact([[wins, missions - wins] for wins, missions in counts[:2]]).pvalue
    texts = {name: f"{100 * end:z.0f}" for name, end in ends.items()}
    texts["p"] = "p < 0.001" if chance < 0.001 else f"p = {chance:.2g}"
    found = {name: ends[name] for name in ends if told.get(name) == _AS_PRINTED}
    return found | {"paper_tells": told["paper_tells"].format_map(texts)}


def _spread(counts: Sequence[Count]) -> Interval:
    """Difference of two rates, recovered share of three, difference of two losses of four."""
    if len(counts) == 3:
        return recovered_share(*counts)
    first, second, *others = (wilson(*each) for each in counts)
    loss = first.minus(second)
    return loss.minus(others[0].minus(others[1])) if others else loss


def _arguments(given: Mapping[str, Any], sets: Mapping[str, Any]) -> dict[str, Any]:
    """What a measure is given: named flights become the columns that choose them."""
    found: dict[str, Any] = {}
    for name, value in given.items():
        if name == "flights":
            found |= _arguments(sets[value], sets)
        elif isinstance(value, Mapping):
            found[name] = _arguments(value, sets)
        else:
            found[name] = tuple(value) if isinstance(value, list) else value
    return found


CLAIMS = tuple(_read(_FILE))
