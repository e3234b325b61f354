"""Answers for the first screen: whether the paper is reproduced, where it is not, what helps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from pathlib import Path
from typing import Any, Self

import numpy as np

from mavfi_cli.analysis.flights import COSTS
from mavfi_cli.analysis.pairs import Balance, Fate, Flights
from mavfi_cli.core.config import read_toml
from mavfi_cli.core.types import FloatArray
from mavfi_cli.paper.items import BY_NAME, STACKS, Regime, printed_name
from mavfi_cli.paper.verdicts import ISOLATED, LEVEL, JudgedClaim, Judgement, Verdict
from mavfi_cli.report.paper import DETECTOR_TITLES
from mavfi_cli.stats.shares import Share, wilson

LEVELS = {"source": "states", "instruction": "instructions"}
_DECIDED = 0.25  # an answer needs this share of decided claims, and no more open than decided ones
_COMPUTER = "x86"  # platform of the answers; only the table of balances covers all platforms
_KINDS: Mapping[str, tuple[Mapping[str, Any], Fate]] = {  # columns, effect on the struck node
    "a wrong value in a state": ({"level": "source"}, Fate.ALL),
    "a fault in an instruction, silent": ({"level": "instruction"}, Fate.SILENT),
    "a fault in an instruction that ends its node": ({"level": "instruction"}, Fate.DEAD),
    "a killed process": ({"killed": True, "struck": False, "bare_struck": False}, Fate.ALL),
}


def judgement_of(judged: JudgedClaim, place: str, fate: Fate = Fate.ALL) -> Judgement | None:
    """Return the judgement of a claim at a place, or in isolated kernels if it is about those.

    Return None if the claim was not judged there for faults of this fate.

    Args:
        place: name of a regime.
    """
    where = ISOLATED if judged.claim.isolated else place
    return judged.judgements.get(where, {}).get(fate)


_SHORT = {
    "gad": "GAD", "aad": "AAD", "pc": "P+C", "pid": "PID", "octomap": "OctoMap",
    "rrtstar": "RRT*", "rrtconnect": "RRTConnect", "seq": "number", "1": "1 bit", "5": "5 bits",
}  # fmt: skip


def short_name(judged: JudgedClaim) -> str:
    """Return a claim's name in two or three words, such as `Fig. 8 velocity`."""
    item, *words = judged.claim.name.split("-")
    return " ".join([printed_name(item), *(_SHORT.get(word, word) for word in words)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """The claims about one figure, table or section of the paper."""

    name: str
    title: str
    claims: Sequence[JudgedClaim]

    @property
    def short(self) -> str:
        """The paper's name for the figure, table or section, such as `Fig. 6`."""
        return printed_name(self.name)

    @classmethod
    def of(cls, claims: Sequence[JudgedClaim]) -> list[Self]:
        """Group consecutive claims about the same figure, table or section."""
        families = []
        for name, members in groupby(claims, lambda judged: judged.claim.item):
            title = f": {BY_NAME[name].title}" if name in BY_NAME else ""
            families.append(cls(name=name, title=printed_name(name) + title, claims=[*members]))
        return families


# Does it reproduce the paper? ---------------------------------------------------------------------


def answer(claims: Sequence[JudgedClaim], place: str) -> str:
    """Return a sentence on how far a place and the isolated kernels reproduce the paper."""
    counts = _count_verdicts(claims, place)
    yes, no, open_ = (
        counts[verdict] for verdict in (Verdict.REPRODUCED, Verdict.CONTRADICTED, Verdict.UNDECIDED)
    )
    if not yes + no + open_:
        return "Nothing here decides a claim of the paper."
    begin = "Only in part" if yes and no else "Yes" if yes else "No"
    begin += ", as far as it is decided" if open_ and bool(yes) is not bool(no) else ""
    if yes + no < max(open_, _DECIDED * len(claims)):
        begin = "Not known yet"
    judged = yes + no + open_
    claims_are = "claim that is" if judged == 1 else "claims that are"
    return (
        f"{begin}: of the {judged} {claims_are} judged, {yes} {_are(yes)} reproduced, "
        f"{no} {_are(no)} contradicted, and {open_} {_are(open_)} undecided at this number of "
        "missions."
    )


def crash_sentence(claims: Sequence[JudgedClaim], place: str, flights: Flights) -> str:
    """Return sentences on how reproduced claims and lost missions depend on dead nodes.

    The first counts the reproduced claims that silent faults alone reproduce too, the second the
    lost missions whose fault ended a node. Each is left out if there are no such claims or losses.
    """
    parts = []
    pairs = [
        (of_all, silent)
        for judged in claims
        if (of_all := judgement_of(judged, place))
        and (silent := judgement_of(judged, place, Fate.SILENT))
    ]
    yes = [silent.verdict for of_all, silent in pairs if of_all.verdict is Verdict.REPRODUCED]
    if yes:
        kept = yes.count(Verdict.REPRODUCED)
        parts.append(
            f"{kept} of {len(yes)} reproduced claims about faults {_are(kept)} also reproduced by "
            "silent faults alone, which the paper studies."
        )
    hit = flights.struck(level="instruction", platform=_COMPUTER).chosen(own_lost=False, lost=True)
    if len(hit):
        ended = wilson(sum(hit["ended"]), len(hit))
        parts.append(
            f"{ended.counts} missions that a fault in an instruction loses follow a node that "
            "crashed or hung."
        )
    return " ".join(parts)


def _count_verdicts(claims: Sequence[JudgedClaim], place: str) -> Counter[Verdict]:
    """Count the claims with each verdict, at a place or in isolated kernels."""
    judgements = (judgement_of(judged, place) for judged in claims)
    return Counter(judgement.verdict for judgement in judgements if judgement)


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


# Disagreements ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Disagreement:
    """Claims that are contradicted for the same reason.

    Attributes:
        reason: why they are contradicted, in words; empty if no reason is known.
    """

    claims: Sequence[JudgedClaim]
    reason: str

    @property
    def names(self) -> Mapping[str, str]:
        """Short names, keyed by claim name. Consecutive claims of an item name it only once."""
        names, item = {}, ""
        for judged in self.claims:
            short, item_before, item = short_name(judged), item, judged.claim.item
            same = f"{printed_name(item)} " if item == item_before else ""
            names[judged.claim.name] = short.removeprefix(same)
        return names


def disagreements(claims: Sequence[JudgedClaim], place: str) -> list[Disagreement]:
    """Group the claims that are contradicted at a place by reason, in the order of the claims.

    Those without a known reason are the last group.
    """
    by_reason: dict[str, list[JudgedClaim]] = {}
    for judged in claims:
        judgement = judgement_of(judged, place)
        if judgement and judgement.verdict is Verdict.CONTRADICTED:
            by_reason.setdefault(reason_of(judged, place), []).append(judged)
    known_first = sorted(by_reason.items(), key=lambda group: not group[0])
    return [Disagreement(claims=mine, reason=reason) for reason, mine in known_first]


def reason_of(judged: JudgedClaim, place: str) -> str:
    """Return the known reason why a claim is contradicted at a place, or an empty string.

    A reason explains one effect, on one stack under one rule or in isolated kernels. It is returned
    only if the claim is contradicted and its effect lies in the interval that the reason explains.
    """
    where = Regime(STACKS[0]) if judged.claim.isolated else Regime.of(place)
    words, low, high = REASONS.get((where.stack, where.rule, judged.claim.name), ("", 0.0, 0.0))
    judgement = judgement_of(judged, place)
    if not judgement or judgement.verdict is not Verdict.CONTRADICTED or judgement.effect is None:
        return ""
    return words if low <= judgement.effect.value <= high else ""


def _read_reasons() -> Mapping[tuple[str, str, str], tuple[str, float, float]]:
    data, _ = read_toml(Path(__file__).parent / "reasons.toml")
    return {
        (reason.get("stack", STACKS[0]), reason.get("rule", ""), name): (reason["words"], *ends)
        for reason in data["reason"]
        for name, ends in reason["intervals"].items()
    }


REASONS = _read_reasons()
"""Reasons for contradicted claims, and the interval of effects that each explains.

The keys are the stack, the injector and restart rule as in `Regime`, and the claim's name.
"""


# What a designer should do ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorBalance:
    """The harm that a detector undoes and the harm that it causes, on the same faults.

    Attributes:
        level: `source` or `instruction`.
        fate: the effect of the faults on their nodes.
        harmed, lost: balances of harmed and of lost missions.
    """

    stack: str
    level: str
    computer: str
    detector: str
    fate: Fate
    harmed: Balance
    lost: Balance

    @classmethod
    def of(cls, stack: str, flights: Flights) -> Iterator[Self]:
        """Yield the balance for each combination of level, platform, detector and fate of faults.

        A pair is a fault that was flown without and with the detector. Combinations without pairs
        are omitted.
        """
        watched = flights.comparable.chosen(detector=(*DETECTOR_TITLES,), bare_struck=True)
        for level, computer, detector in sorted(
            watched.by("level", "platform", "detector"), key=str
        ):
            for fate in Fate if level == "instruction" else (Fate.ALL,):
                where = {"level": level, "platform": computer}
                harmed, lost = (
                    flights.of_fate(fate).balance(detector, column=column, **where)
                    for column in ("harmed", "lost")
                )
                if harmed.pairs:
                    yield cls(
                        stack=stack, level=level, computer=computer, detector=detector, fate=fate,
                        harmed=harmed, lost=lost,
                    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Against:
    """The effect of a protection, or of another stack, against one kind of fault.

    Attributes:
        effect: `helps`, `harms`, `no proven effect` or `nothing to undo`, by a test at LEVEL.
        counts: the numbers behind the effect, in words.
    """

    effect: str
    counts: str

    @classmethod
    def of_pairs(cls, harmed: Balance, lost: Balance) -> _Against | None:
        """Judge a protection by McNemar's test of the harm by the same faults.

        Return None without pairs.
        """
        if not harmed.pairs:
            return None
        ill = harmed.before + harmed.caused
        counts = f"no harm in {harmed.pairs:,} pairs"
        if ill:
            undone = {"harmed": harmed, "lost": lost}
            parts = (
                f"{name}: {own.undone:,} of {own.before:,} undone, {own.caused:,} caused"
                for name, own in undone.items()
            )
            p = "p < 0.001" if harmed.p_value < 0.001 else f"p = {harmed.p_value:.2g}"
            counts = f"{'; '.join(parts)}; {harmed.pairs:,} pairs, {p}"
        proven = harmed.p_value < LEVEL
        return cls(effect=_effect(ill, harmed.undone > harmed.caused, proven), counts=counts)

    @classmethod
    def of_shares(cls, before: Share, after: Share) -> _Against | None:
        """Judge another stack by the change in the share of harmed missions.

        Return None if there are no missions on one of the stacks.
        """
        if not (before.total and after.total):
            return None
        change = after.minus(before)
        proven = change.high < 0.0 or change.low > 0.0
        counts = f"harmful {after.counts} instead of {before.counts}"
        return cls(
            effect=_effect(before.count + after.count, change.value < 0, proven), counts=counts
        )


def _effect(ill: int, better: bool, proven: bool) -> str:
    if not ill:
        return "nothing to undo"
    return ("helps" if better else "harms") if proven else "no proven effect"


@dataclass(frozen=True, slots=True, kw_only=True)
class Safeguard:
    """A protection or another stack, with its effect against each kind of fault and its costs.

    Attributes:
        place: name of the regime whose flights it protects; empty if `name` contains it.
        against: effect, keyed by kind of fault; None if that kind was not flown.
        costs: mean share of the flight time that detection and recovery take, by name of the level;
            empty if not measured.
    """

    name: str
    place: str
    against: Mapping[str, _Against | None]
    costs: Mapping[str, float]


def protections(
    flights: Mapping[str, Flights], beside: Mapping[str, Flights] | None = None
) -> list[Safeguard]:
    """Judge detectors at the first place, all arms, and our own stack instead of the first.

    All of these are omitted if nothing was flown to judge them. Arms are judged under the usual
    rule.

    Args:
        flights: flights by place, from `Evidence.by_place`.
        beside: flights of arms beside those without one, by place; see `Flights.beside_base`.
    """
    name, first = next(iter(flights.items()))
    usual = [place for place in flights if not Regime.of(place).rule]
    own = [place for place in usual if Regime.of(place).stack == Regime.of(name).stack]
    others = [place for place in usual if place not in own and Regime.of(place).stack == STACKS[-1]]
    detectors = {
        detector.upper(): _safeguard(f"{title} detector", name, first, detector)
        for detector, title in DETECTOR_TITLES.items()
    }
    arms = [
        _safeguard(arm, place, mine, arm)
        for place, mine in (beside or {}).items()
        if not Regime.of(place).rule
        for arm in sorted({*mine["detector"]} - {None})
    ]
    # A detector alone is an arm, too. It is left out if it has the same flights as above.
    same = {name: guard.against for name, guard in detectors.items()}
    safeguards = [*detectors.values()]
    safeguards += [arm for arm in arms if arm.against != same.get(arm.name)]
    for one, other in product(own, others):
        both = flights[one], flights[other]
        shares = [_harmed(*both), _harmed(*reversed(both))]
        against = {kind: _Against.of_shares(*(mine[kind] for mine in shares)) for kind in _KINDS}
        name = f"{other} instead of {one}"
        safeguards.append(Safeguard(name=name, place="", against=against, costs={}))
    return [protection for protection in safeguards if any(protection.against.values())]


def _safeguard(name: str, place: str, flights: Flights, detector: str) -> Safeguard:
    """Judge a detector, or an arm that stands in its column, on the same faults without it."""
    against = {}
    for kind, (own, fate) in _KINDS.items():
        # The golden flight of the unprotected flight succeeds, too.
        where = {"platform": _COMPUTER, "bare_harmed": (True, False), **own}
        harmed, lost = (
            flights.of_fate(fate).balance(detector, column=column, **where)
            for column in ("harmed", "lost")
        )
        against[kind] = _Against.of_pairs(harmed, lost)
    return Safeguard(name=name, place=place, against=against, costs=_costs(flights, detector))


def _costs(flights: Flights, detector: str) -> dict[str, float]:
    """Return the mean share of the flight time that detection and recovery take, by level."""
    seen = flights.comparable.struck(detector=detector, platform=_COMPUTER)
    shares = {level: seen.chosen(level=level).known(*COSTS) for level in LEVELS}
    return {LEVELS[level]: float(mine.mean()) for level, mine in shares.items() if len(mine)}


def _harmed(flights: Flights, others: Flights) -> dict[str, Share]:
    """Return the share of harmed missions in `flights`, keyed by kind of fault.

    Only scenes that `others` contains too are counted. A scene is a world with a mission seed.
    """
    scenes = {*_scenes(others)}
    mine = flights.where(scene in scenes for scene in _scenes(flights))
    return {
        kind: mine.of_fate(fate).struck(platform=_COMPUTER, **where).share("harmed")
        for kind, (where, fate) in _KINDS.items()
    }


def _scenes(flights: Flights) -> Iterator[tuple[object, ...]]:
    return zip(flights["world"], flights["world_seed"], flights["seed"], strict=True)


# Added time ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Delays:
    """The delays that the same faults cause without a detector and with each detector.

    Attributes:
        level: `source` or `instruction`.
        added_s: added flight times in seconds, sorted, in an array of shape (n,) for each detector;
            infinite for lost missions. The key None stands for no detector.
        golden_s: mean flight time of the golden flights, in seconds.
    """

    stack: str
    level: str
    added_s: Mapping[str | None, FloatArray]
    golden_s: float

    @classmethod
    def of(cls, stack: str, flights: Flights) -> Iterator[Self]:
        """Yield the delays at each level, for faults flown both without and with every detector."""
        hit = flights.comparable.chosen(struck=True, own_lost=False, platform=_COMPUTER)
        for level in ("source", "instruction"):
            mine = hit.chosen(level=level)
            if None not in mine["detector"]:
                continue
            arms = mine.shared().by("detector")
            added = {
                name: np.sort(
                    np.where(arms[name,].flags("lost"), np.inf, arms[name,].numbers("added_s"))
                )
                for name in (None, *DETECTOR_TITLES)
                if (name,) in arms
            }
            golden_s = float(np.nanmean(mine.numbers("own_flight_time_s")))
            yield cls(stack=stack, level=level, added_s=added, golden_s=golden_s)


def delay_sentence(parts: Sequence[Delays]) -> str:
    """Return sentences on how many flights are lost or over 1 s late, with and without detectors.

    The result is empty if nothing was flown with a detector.
    """
    sentences = []
    for part in parts:
        longer = {name: int((added > 1.0).sum()) for name, added in part.added_s.items()}
        if len(longer) > 1:
            bare, faults = longer.pop(None), len(part.added_s[None])
            watched = " and ".join(
                f"{count:,} with the {DETECTOR_TITLES[name or '']} detector"
                for name, count in longer.items()
            )
            sentences.append(
                f"{faults:,} faults in {LEVELS[part.level]} were flown without and with detectors. "
                f"Lost, or late by over 1 s: {bare:,} without a detector, {watched}."
            )
    return " ".join(sentences)
