"""The claims of the paper: their words, the numbers that decide them, and their ranges.

claims.toml lists the claims, and measures.py computes the numbers. Each claim about faults is
judged three times: for all faults, for silent ones, and for those that end a node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.pairs import Fate, Flights
from mavfi_cli.core.config import read_toml
from mavfi_cli.paper.items import Regime
from mavfi_cli.paper.measures import (
    MEASURES,
    NOT_FLOWN,
    OF_GOLDEN,
    OF_KERNELS,
    WITHOUT_FATES,
    Kernels,
)
from mavfi_cli.paper.verdicts import (
    ISOLATED,
    Claim,
    Finding,
    JudgedClaim,
    Judgement,
    Settling,
    Verdict,
    judge,
    margin,
)
from mavfi_cli.stats.paired import Count, recovered_share
from mavfi_cli.stats.shares import Interval, wilson

_FILE = Path(__file__).parent / "claims.toml"
_FACTOR = 3.0  # effects from a third to three times a stated size reproduce it
_NONE = {Fate.SILENT: "none of the faults is silent", Fate.DEAD: "none of the faults ends a node"}
_GOLDEN = Judgement(
    verdict=Verdict.NOT_DECIDABLE, why="the rule does not affect flights without a fault"
)
_WHOLE = ("points", "percent")  # units of shares, which are at most 1


def judged(
    flights: Mapping[str, Flights],
    kernels: Kernels,
    settled: Mapping[str, Settling] | None = None,
) -> list[JudgedClaim]:
    """Return all claims with their verdicts, in the order of CLAIMS.

    Args:
        flights: the flights in each regime, keyed by its name. A claim about flights without a
            fault is judged only where the rule is the usual one.
        kernels: summaries of the isolated kernels, keyed by name.
        settled: for each regime, the record of the missions flown to settle claims; one without
            such missions is omitted.
    """
    settled = settled or {}
    judgements: dict[str, dict[str, dict[Fate, Judgement]]] = {claim.name: {} for claim in CLAIMS}
    for _, family in groupby(CLAIMS, attrgetter("item")):
        members = list(family)
        alone = [claim for claim in members if claim.isolated]
        flown = [claim for claim in members if not claim.isolated]
        nothing = Flights.pooled([])
        for claim, judgement in zip(alone, _judge(alone, nothing, kernels), strict=True):
            judgements[claim.name][ISOLATED] = {Fate.ALL: judgement}
        for place, those in flights.items():
            usual = not Regime.of(place).rule
            for claim in flown:
                if claim.golden and not usual:
                    judgements[claim.name][place] = {Fate.ALL: _GOLDEN}
            for fate in Fate:
                applicable = [
                    claim for claim in flown if fate in claim.fates and (usual or not claim.golden)
                ]
                verdicts = _judge(
                    applicable, those.of_fate(fate), kernels, fate, settled.get(place)
                )
                for claim, judgement in zip(applicable, verdicts, strict=True):
                    cells = judgements[claim.name].setdefault(place, {})
                    if judgement.why == NOT_FLOWN.why != cells.get(Fate.ALL, judgement).why:
                        judgement = replace(judgement, why=_NONE[fate])
                    cells[fate] = judgement
    return [JudgedClaim(claim=claim, judgements=judgements[claim.name]) for claim in CLAIMS]


def _judge(
    family: Sequence[Claim],
    flights: Flights,
    kernels: Kernels,
    fate: Fate = Fate.ALL,
    settled: Settling | None = None,
) -> list[Judgement]:
    looks = None
    if settled is not None:
        looks = [settled.first_look(claim.name, fate.value) for claim in family]
    ranges = [(claim.low, claim.high) for claim in family]
    findings = [claim.find(flights, kernels) for claim in family]
    verdicts = judge(findings, ranges, looks)
    by_name = {claim.name: verdict for claim, verdict in zip(family, verdicts, strict=True)}
    void = False
    for place, claim in enumerate(family):
        if claim.premise and by_name[claim.premise].verdict is Verdict.CONTRADICTED:
            void, why = True, f"its premise does not hold here: {claim.premise} is contradicted"
            findings[place] = Finding(counts=findings[place].counts, why=why)
    if void:
        verdicts = judge(findings, ranges, looks)
    if settled is None:
        return verdicts
    return [
        replace(
            verdict,
            without_size=excludes(claim.size, verdict.bounds),
            history=settled.describe(claim.name),
        )
        for claim, verdict in zip(family, verdicts, strict=True)
    ]


def excludes(size: float | None, bounds: Interval | None) -> bool:
    """Return True if both bounds of an effect are closer to 0 than `size`."""
    return size is not None and bounds is not None and -size < bounds.low and bounds.high < size


# claims.toml --------------------------------------------------------------------------------------


def _read(path: Path) -> Iterator[Claim]:
    data, _ = read_toml(path)
    for entry in data["claim"]:
        measure, given = entry.pop("measure"), entry.pop("given", {})
        counts = [(wins, missions) for wins, missions in entry.pop("paper_counts", ())]
        if counts:
            entry["paper_tells"] = _in_the_paper(entry["paper_tells"], counts)
        size = entry.get("size")
        low, high, rule = _range(entry)
        yield Claim(
            item=entry["name"].partition("-")[0],
            find=_finder(measure, _arguments(given, data["flights"])),
            low=low,
            high=high,
            rule=rule,
            size=size,
            isolated=measure in OF_KERNELS,
            golden=measure in OF_GOLDEN,
            fates=(Fate.ALL,) if measure in WITHOUT_FATES else tuple(Fate),
            **entry,
        )


def _range(entry: dict[str, Any]) -> tuple[float, float, str]:
    """Remove the range from a claim's entry. Return its low and high end, and its rule in words."""
    whole = entry.get("unit", "points") in _WHOLE
    if "size" in entry:
        size = entry.pop("size")
        high = math.inf if whole and _FACTOR * size >= 1.0 else _FACTOR * size
        return size / _FACTOR, high, "a third of the paper's size to three times it"
    for kind, words in _DIRECTIONS.items():
        if kind in entry:
            missions = entry.pop(kind)
            least = margin(missions)
            rule = f"{words.format(f'{100 * least:g}')}, which {missions:,} runs can rule out"
            low = -math.inf if kind == "less" else least if kind == "more" else -least
            return low, math.inf if kind == "more" else least if kind == "alike" else -least, rule
    rule = "as the words state it" if {"low", "high"} & entry.keys() else "none"
    return entry.pop("low", -math.inf), entry.pop("high", math.inf), rule


_DIRECTIONS = {
    "more": "above {} points",
    "less": "below -{} points",
    "alike": "within {} points of nothing",
}


def _finder(measure: str, given: dict[str, Any]) -> Callable[[Flights, Kernels], Finding]:
    function = partial(MEASURES[measure], **given)
    if measure in OF_KERNELS:
        return lambda _, kernels: function(kernels)
    if measure == "ranking":
        return function
    return lambda flights, _: function(flights)


def _in_the_paper(words: str, counts: Sequence[Count]) -> str:
    from scipy.stats import fisher_exact

    spread = _spread(counts)
    texts = {name: f"{100 * getattr(spread, name):z.0f}" for name in ("low", "high")}
    if len(counts) > 1:
        chance = fisher_exact([[wins, missions - wins] for wins, missions in counts[:2]]).pvalue
        texts["p"] = "p < 0.001" if chance < 0.001 else f"p = {chance:.2g}"
    return words.format_map(texts)


def _spread(counts: Sequence[Count]) -> Interval:
    """Return the interval of the number that a claim's counts give.

    One count gives a rate, two a difference of rates, three the share of losses that a protection
    recovers, and four a difference of two losses.
    """
    if len(counts) == 3:
        return recovered_share(*counts)
    first, *others = (wilson(*count) for count in counts)
    if not others:
        return first.effect
    loss = first.minus(others[0])
    return loss.minus(others[1].minus(others[2])) if others[1:] else loss


def _arguments(given: Mapping[str, Any], sets: Mapping[str, Any]) -> dict[str, Any]:
    """Return a measure's arguments, with named flights replaced by the columns that select them."""
    arguments: dict[str, Any] = {}
    for name, value in given.items():
        if name == "flights":
            arguments |= _arguments(sets[value], sets)
        elif isinstance(value, Mapping):
            arguments[name] = _arguments(value, sets)
        else:
            arguments[name] = tuple(value) if isinstance(value, list) else value
    return arguments


CLAIMS = tuple(_read(_FILE))
