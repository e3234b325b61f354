"""The claims, and the verdicts that compare a claim's effect with its range.

The ranges in claims.toml come from the paper alone, not from our missions. A verdict tests the
effect against the nearest end of the range. The tests of one figure or table form a family,
corrected by Holm's method (S. Holm, Scand. J. Statistics 6, 1979).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from typing import Any, Self

from mavfi_cli.analysis.kernels import IsolatedKernel
from mavfi_cli.analysis.pairs import Fate, Flights
from mavfi_cli.campaigns.progress import duration
from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, lack_of
from mavfi_cli.core.files import Json
from mavfi_cli.stats.paired import holm
from mavfi_cli.stats.sequences import anytime_count, anytime_interval, anytime_p
from mavfi_cli.stats.shares import Interval, wilson, z_of

ISOLATED = "isolated kernels"
LEVEL = 0.05  # significance level of a family of tests
_FAMILY = 4  # number of claims per figure or table that `margin` assumes
_HALVES = 2  # of the level: one for the first look, one for all looks together
_STEP = 0.005  # margins are multiples of half a point
_Z = z_of(1.0 - LEVEL)


class Verdict(Enum):
    """Whether the missions and runs reproduce a claim."""

    REPRODUCED = "reproduced"
    CONTRADICTED = "contradicted"
    UNDECIDED = "undecided"
    NOT_DECIDABLE = "not decidable"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """The number that decides a claim, as computed from the missions.

    Attributes:
        effect: number with its 95 % interval; None if there is none.
        counts: description of the missions behind the effect.
        why: the reason why there is no effect.
    """

    effect: Interval | None = None
    counts: str = ""
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """A claim's verdict, and the numbers behind it.

    Attributes:
        effect: number with its 95 % interval, which is not corrected; None if there is none.
        counts: description of the missions behind the effect.
        why: the reason why the claim is not decidable; empty for the other verdicts.
        p: p-value of the test against the nearest end of the range, corrected for its family; 1
            without an effect.
        p_alone: p-value of the same test without a correction for its family or for looks.
        needed: number of observations that would decide an undecided claim if the effect stayed the
            same; infinite if the effect lies on an end of the range; 0 for other verdicts.
        bounds: 95 % interval of the effect that is valid at all looks together; None if no missions
            were added to settle claims.
        without_size: whether the bounds exclude an effect of the claim's size on either side of 0:
            two one-sided tests (D. J. Schuirmann, J. Pharmacokinetics and Biopharmaceutics 15,
            1987).
        history: description of the missions that were added to settle this claim.
    """

    verdict: Verdict
    effect: Interval | None = None
    counts: str = ""
    why: str = ""
    p: float = 1.0
    p_alone: float = 1.0
    needed: float = 0.0
    bounds: Interval | None = None
    without_size: bool = False
    history: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim of the paper; claims.toml explains the fields that are not listed here.

    Attributes:
        item: table, figure or section, such as `fig6`.
        find: function that computes the finding from a stack's flights and the isolated kernels.
        low, high: ends of the range of the effect.
        size: size of the effect in the paper; None if the paper does not state it.
        rule: the range and its origin, in words.
        isolated: whether the claim is about isolated kernels instead of flights.
        golden: whether it is about flights without a fault.
        fates: fates of faults for which the claim is judged separately.
    """

    name: str
    item: str
    words: str
    effect: str
    find: Callable[[Flights, Mapping[str, IsolatedKernel]], Finding]
    low: float
    high: float
    rule: str
    size: float | None = None
    paper: str = "no number printed"
    unit: str = "points"
    paper_tells: str = "drawn only, without counts"
    premise: str = ""
    isolated: bool = False
    golden: bool = False
    fates: tuple[Fate, ...] = tuple(Fate)


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedClaim:
    """A claim with its judgements on stacks or in isolated kernels.

    Attributes:
        judgements: judgements by regime or ISOLATED, and then by the fate of the faults.
    """

    claim: Claim
    judgements: Mapping[str, Mapping[Fate, Judgement]]

    def verdict(self, place: str, fate: Fate = Fate.ALL) -> Verdict | None:
        """Return the verdict at `place`, or None if the claim was not judged there.

        Args:
            place: a regime or ISOLATED.
        """
        judgement = self.judgements.get(place, {}).get(fate)
        return None if judgement is None else judgement.verdict

    def as_dict(self) -> Json:
        """Return the claim in words, and its judgements by place and by fate of the faults."""
        judged = {
            place: {
                fate.value: asdict(judgement) | {"verdict": judgement.verdict.value}
                for fate, judgement in fates.items()
            }
            for place, fates in self.judgements.items()
        }
        claim = {name: getattr(self.claim, name) for name in ("name", "item", "words", "unit")}
        return {**claim, "judgements": judged}


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstLook:
    """The test of a claim before any mission was added to settle it.

    Attributes:
        p: p-value without a correction for the claim's family.
        inside: whether the effect lay in the claim's range.
    """

    p: float
    inside: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SettledClaim:
    """The missions that were flown to settle one claim.

    Attributes:
        looks: number of looks that followed missions flown for this claim.
        missions: number of those missions; other claims use them as well.
        seconds: wall time of those missions, in seconds.
        verdict: the verdict at the last look.
    """

    looks: int = 0
    missions: int = 0
    seconds: float = 0.0
    verdict: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settling:
    """The record of the looks at claims, and of the missions flown to settle them.

    Attributes:
        first: first look at each claim that had an effect then, keyed by claim name and then by
            the fate of the faults.
        looks: number of looks that followed missions flown for any claim.
        claims: missions flown for each claim, keyed by claim name; claims without such missions are
            omitted.
    """

    first: Mapping[str, Mapping[str, FirstLook]] = field(default_factory=dict)
    looks: int = 0
    claims: Mapping[str, SettledClaim] = field(default_factory=dict)

    @classmethod
    def of(cls, stored: Any) -> Self | None:
        """Parse a record that was stored as JSON, from its text or its decoded contents.

        Return None if `stored` is None, because nothing was settled.

        Raises:
            ConfigError: the contents do not have the expected structure.
        """
        if stored is None:
            return None
        try:
            contents = json.loads(stored) if isinstance(stored, str) else stored
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"is not JSON: {lack_of(error)}") from None
        return structure(contents, cls)

    def to_json(self) -> str:
        """Return the record as JSON text that `of` can parse."""
        return json.dumps(asdict(self), sort_keys=True)

    def first_look(self, name: str, fate: str) -> FirstLook | None:
        """Return the first look at a claim for one fate, or None if it had no effect then."""
        return self.first.get(name, {}).get(fate)

    def describe(self, name: str) -> str:
        """Describe the missions that were flown to settle a claim."""
        claim = self.claims.get(name)
        if claim is None:
            return "no mission was added for it"
        return (
            f"{claim.missions:,} missions were added for it in {duration(claim.seconds)}, at "
            f"{claim.looks} of {self.looks} looks"
        )


def judge(
    findings: Sequence[Finding],
    ranges: Sequence[tuple[float, float]],
    first: Sequence[FirstLook | None] | None = None,
) -> list[Judgement]:
    """Judge a family of claims, and correct the p-values for the number of claims.

    If missions were added to settle claims, half of the level is spent on the first look, whose
    number of missions was planned, and half on all looks together. A p-value is then twice the
    smaller of `anytime_p` and the p-value at the first look. The latter counts only if the effect
    has moved neither into the range nor out of it since then.

    Args:
        findings: finding of each claim.
        ranges: low and high end of each claim's range, both inclusive.
        first: first look at each claim, or None for a claim that had no effect then. The whole
            argument is None if no missions were added.
    """
    z = [_z(finding.effect, *ends) for finding, ends in zip(findings, ranges, strict=True)]
    tested = [place for place, value in enumerate(z) if not math.isnan(value)]
    counts = [0 if finding.effect is None else finding.effect.count for finding in findings]
    inside = [finding.effect is not None and low <= finding.effect.value <= high
              for finding, (low, high) in zip(findings, ranges, strict=True)]  # fmt: skip
    alone = {place: _two_sided(z[place]) for place in tested}
    tests = [
        alone[place]
        if first is None
        else _at_any_look(z[place], counts[place], first[place], inside=inside[place])
        for place in tested
    ]
    p = dict(zip(tested, holm(tests), strict=True))
    level = LEVEL / max(1, len(tested))
    judged = []
    for place, finding in enumerate(findings):
        judgement = Judgement(
            verdict=Verdict.NOT_DECIDABLE,
            counts=finding.counts,
            why=finding.why or "the flights give no interval",
        )
        if place in p and finding.effect is not None:
            undecided = p[place] >= LEVEL
            decided = Verdict.REPRODUCED if inside[place] else Verdict.CONTRADICTED
            needed = math.inf
            if first is not None:
                needed = anytime_count(z[place], counts[place], level / _HALVES)
            elif z[place]:
                needed = counts[place] * (z_of(1.0 - level) / z[place]) ** 2
            judgement = replace(
                judgement,
                verdict=Verdict.UNDECIDED if undecided else decided,
                effect=finding.effect,
                why="",
                p=p[place],
                p_alone=alone[place],
                needed=needed if undecided else 0.0,
                bounds=None if first is None else anytime_interval(finding.effect),
            )
        judged.append(judgement)
    return judged


def _z(effect: Interval | None, low: float, high: float) -> float:
    """Return the distance from an effect to the nearest end of its range, in standard errors.

    The standard error is that of the interval's side that faces the end. The result is NaN without
    an interval.
    """
    if effect is None or math.isnan(effect.low) or math.isnan(effect.high):
        return math.nan
    below, above = effect.value - effect.low, effect.high - effect.value
    if effect.value < low:
        distances = [(low - effect.value, above)]
    elif effect.value > high:
        distances = [(effect.value - high, below)]
    else:
        distances = [(effect.value - low, below), (high - effect.value, above)]
    return min(
        _Z * distance / side if side else math.inf if distance else 0.0
        for distance, side in distances
    )


def _at_any_look(z: float, count: int, first: FirstLook | None, *, inside: bool) -> float:
    p = anytime_p(z, count)
    if first is not None and first.inside is inside:
        p = min(p, first.p)
    return min(1.0, _HALVES * p)


def _two_sided(z: float) -> float:
    return math.erfc(z / math.sqrt(2.0))


def margin(missions: int) -> float:
    """Return the smallest effect that groups of `missions` missions each can rule out.

    A rate of 0 in so many missions rules this effect out in a family of four claims, so a claim of
    such an effect can be contradicted. The effect is the upper end of Wilson's interval for 0 of
    n at confidence 1 - 0.05/4, rounded up to half a point.
    """
    high = wilson(0, missions, confidence=1.0 - LEVEL / _FAMILY).high
    return math.ceil(high / _STEP) * _STEP
