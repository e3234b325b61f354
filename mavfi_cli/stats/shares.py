"""Proportions with confidence intervals, sample sizes, and the effect of SDCs on missions.

Runs are independent or come in clusters. In a clustered sample, each run strikes one cluster: a
sampled window of executed instructions. Clusters are drawn uniformly from a stratum, such as the
windows that begin at one function. The formulas are those of W. G. Cochran, Sampling Techniques,
3rd edition, 1977. The spread of a few clusters is a poor estimate, so the quantiles are Student's,
with the degrees of freedom of F. E. Satterthwaite (Biometrics Bulletin 2, 1946).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from mavfi_cli.core.errors import ConfigError

if TYPE_CHECKING:
    from mavfi_cli.core.types import FloatArray  # loads numpy

_LEAST = 1e-6  # smaller margins and differences need more missions than anyone can fly


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """The value of a statistic, the ends of its confidence interval, and the sample size.

    The value or the ends are NaN if the sample is too small.
    """

    value: float
    low: float
    high: float
    count: int

    def minus(self, other: Interval) -> Interval:
        """Return this statistic minus an independent one, with the interval of the difference.

        The distances between the values and the ends of their intervals add in quadrature (MOVER).
        The sample size is the smaller one of the two.
        """
        value = self.value - other.value
        below = math.hypot(self.value - self.low, other.high - other.value)
        above = math.hypot(self.high - self.value, other.value - other.low)
        count = min(self.count, other.count)
        return Interval(value=value, low=value - below, high=value + above, count=count)

    @staticmethod
    def welch(first: FloatArray, second: FloatArray, confidence: float = 0.95) -> Interval:
        """Return the mean of `second` minus that of `first`, with Welch's confidence interval.

        It does not assume equal variances (B. L. Welch, Biometrika 34, 1947). The result is NaN if
        a sample is empty. Its ends are NaN if a sample has a single value.

        Args:
            first, second: (n,) and (m,) independent values.
        """
        from scipy.stats import ttest_ind

        count = min(len(first), len(second))
        if not count:
            return NO_INTERVAL
        first, second = first - first[0], second - first[0]  # equal values differ by exactly 0
        value, low, high = float(second.mean() - first.mean()), math.nan, math.nan
        if count > 1:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # for equal values
                test = ttest_ind(second, first, equal_var=False)
                low, high = map(float, test.confidence_interval(confidence))
        return Interval(value=value, low=low, high=high, count=count)


NO_INTERVAL = Interval(value=math.nan, low=math.nan, high=math.nan, count=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A proportion with its counts, and the ends of its confidence interval."""

    count: int
    total: int
    share: float
    low: float
    high: float

    @property
    def effective(self) -> int:
        """Number of uniformly drawn observations that would give an equally wide interval."""
        return self.total

    @property
    def counts(self) -> str:
        """Count and total as text, such as `3 of 98`."""
        return f"{self.count:,} of {self.total:,}"

    @property
    def effect(self) -> Interval:
        """The proportion as an `Interval` whose sample size is `total`."""
        return Interval(value=self.share, low=self.low, high=self.high, count=self.total)

    def minus(self, other: Share) -> Interval:
        """Return this rate minus an independent one, with the hybrid score interval.

        This is method 10 of R. G. Newcombe, Statistics in Medicine 17, 1998, which adds the
        distances to the ends of the two Wilson intervals in quadrature. The result is NaN if a rate
        has no observations.
        """
        if not (self.total and other.total):
            return NO_INTERVAL
        difference = self.effect.minus(other.effect)
        return replace(difference, low=max(-1.0, difference.low), high=min(1.0, difference.high))

    def fisher(self, other: Share) -> float:
        """Return the two-sided p-value of Fisher's exact test of whether two rates are equal.

        It is 1 if a rate has no observations. A stratified sample counts as its effective number of
        observations.
        """
        from scipy.stats import fisher_exact

        if not (self.total and other.total):
            return 1.0
        hits = [round(rate.share * rate.effective) for rate in (self, other)]
        misses = [self.effective - hits[0], other.effective - hits[1]]
        return float(fisher_exact([hits, misses]).pvalue)

    def per_hour(self, upsets_per_hour: float) -> tuple[float, float, float]:
        """Return how many missions fail per flight hour if this share of all upsets fail theirs.

        The extrapolation assumes at most one upset per mission, and that an upset does as much harm
        as a fault of the campaign.

        Args:
            upsets_per_hour: bit flips that reach the attacked kernels per flight hour.

        Returns:
            Failed missions per flight hour, and the low and high end of the interval.

        Raises:
            ConfigError: the rate is negative.
        """
        if not upsets_per_hour >= 0.0:
            raise ConfigError(f"must be at least 0, got {upsets_per_hour:g}", key="upsets_per_hour")
        return upsets_per_hour * self.share, upsets_per_hour * self.low, upsets_per_hour * self.high


@dataclass(frozen=True, slots=True, kw_only=True)
class StratifiedShare(Share):
    """A proportion estimated from a weighted, stratified sample, with its effective sample size."""

    effective: int = field()


def wilson(
    count: int, total: int, *, design_effect: float = 1.0, confidence: float = 0.95
) -> Share:
    """Return the proportion `count` / `total` with its Wilson score interval.

    The interval is that of E. B. Wilson, JASA 22, 1927. Without observations, it is [0, 1] and the
    share is NaN. The number of observations is divided by the design effect; SciPy's
    `proportion_ci` does not support this.
    """
    if total == 0:
        return Share(count=0, total=0, share=math.nan, low=0.0, high=1.0)
    low, high = score_interval(count / total, total / design_effect, confidence)
    return Share(count=count, total=total, share=count / total, low=low, high=high)


def score_interval(share: float, number: float, confidence: float) -> tuple[float, float]:
    """Return the ends of the Wilson interval of a proportion `share`.

    Args:
        number: number of observations, above 0; need not be an integer.
    """
    z = z_of(confidence)
    z2 = z**2
    centre = (share + z2 / (2 * number)) / (1 + z2 / number)
    root = math.sqrt(share * (1 - share) / number + z2 / (4 * number**2))
    half = z * root / (1 + z2 / number)
    low = max(0.0, centre - half) if share else 0.0
    return low, min(1.0, centre + half) if share < 1.0 else 1.0


def unseen_share(total: int, confidence: float = 0.95) -> float:
    """Return the upper confidence bound on the probability of an event that was never observed.

    The event occurred in none of `total` independent runs. The bound is the one-sided one of C. J.
    Clopper and E. S. Pearson, Biometrika 26, 1934. It is 1 without runs.
    """
    return 1.0 - (1.0 - confidence) ** (1.0 / total) if total else 1.0  # exact; SciPy iterates


def z_of(confidence: float) -> float:
    """Return the two-sided standard normal quantile for a confidence level: 1.96 for 0.95.

    Raises:
        ConfigError: the confidence is not between 0 and 1.
    """
    from scipy.special import ndtri

    if not 0.0 < confidence < 1.0:
        raise ConfigError(f"must be above 0 and below 1, got {confidence:g}", key="confidence")
    return float(ndtri(0.5 + confidence / 2.0))


def mixture(parts: Sequence[tuple[int, Share]]) -> dict[str, float]:
    """Estimate a population's proportion from those of its parts, weighted by their true sizes.

    The interval adds the distances to the ends of the parts' Wilson intervals in quadrature (MOVER,
    G. Y. Zou and A. Donner, Statistics in Medicine 27, 2008). If the whole is empty, or a part that
    is not empty was never sampled, the share is NaN and the interval is [0, 1].

    Args:
        parts: true size of each part, and the proportion in its sample.

    Returns:
        The proportion and the ends of its interval, as `share`, `low` and `high`.
    """
    whole = sum(size for size, _ in parts)
    if not whole:
        return {"share": math.nan, "low": 0.0, "high": 1.0}
    weighted = [(size / whole, part) for size, part in parts if size]
    share = math.fsum(weight * part.share for weight, part in weighted)
    below = math.hypot(*(weight * (part.share - part.low) for weight, part in weighted))
    above = math.hypot(*(weight * (part.high - part.share) for weight, part in weighted))
    return {"share": share, "low": max(0.0, share - below), "high": min(1.0, share + above)}


def missions_for_margin(margin: float, *, expected: float = 0.5, confidence: float = 0.95) -> int:
    """Return the fewest missions for which a Wilson interval has a half width of at most `margin`.

    The condition (z / (1 + z²/n)) sqrt(p (1 - p)/n + z²/(4 n²)) <= m is, with u = z²/n, the
    quadratic u² (1/4 - m²) + u (p (1 - p) - 2 m²) - m² <= 0.

    Args:
        margin: half of the interval's width.
        expected: expected rate; 0.5 is the worst case.

    Raises:
        ConfigError: the margin is below a millionth or not below 0.5, the expected rate is not in
            [0, 1], or the confidence is not between 0 and 1.
    """
    if not _LEAST <= margin < 0.5:
        raise ConfigError(
            f"must be at least {_LEAST:g} and below 0.5, got {margin:g}", key="margin"
        )
    if not 0.0 <= expected <= 1.0:
        raise ConfigError(f"must be at least 0 and at most 1, got {expected:g}", key="expected")
    z2 = z_of(confidence) ** 2
    a, b, c = 0.25 - margin**2, expected * (1.0 - expected) - 2.0 * margin**2, -(margin**2)
    u = (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return math.ceil(z2 / u - 1e-9)


def pairs_for_difference(
    difference: float, discordant: float, *, confidence: float = 0.95, power: float = 0.8
) -> int:
    """Return how many pairs McNemar's test needs to detect a difference of success rates.

    It is (z_a sqrt(q) + z_b sqrt(q - d²))² / d², where q = `discordant` is the share of pairs whose
    outcomes differ, and d is the difference (R. J. Connor, Biometrics 43, 1987).

    Raises:
        ConfigError: the difference is below a millionth or exceeds the share of differing pairs,
            that share exceeds 1, or the confidence or the power is not between 0 and 1.
    """
    from scipy.special import ndtri

    if not _LEAST <= abs(difference) <= discordant <= 1.0:
        raise ConfigError(
            f"must be at least {_LEAST:g}, and at most the share of pairs with different outcomes "
            f"(--discordant {discordant:g}), got {difference:g}",
            key="difference",
        )
    if not 0.0 < power < 1.0:
        raise ConfigError(f"must be above 0 and below 1, got {power:g}", key="power")
    z_a, z_b = z_of(confidence), float(ndtri(power))
    root = z_a * math.sqrt(discordant) + z_b * math.sqrt(discordant - difference**2)
    return math.ceil(root**2 / difference**2 - 1e-9)


@dataclass(frozen=True, slots=True)
class CrossLayer:
    """How often faults corrupt the output of an isolated kernel, and how often they fail missions.

    Attributes:
        corruption: share of faults in the isolated kernel that silently corrupt its output.
        failure: share of faults that fail the mission.
        failure_given_corruption: `failure` / `corruption`, with the ends of the failure's interval
            divided by the corruption's point estimate. None if the estimate is above 1 (crashes and
            hangs fail missions too) or no output was corrupted.
    """

    corruption: Share
    failure: Share
    failure_given_corruption: tuple[float, float, float] | None


def cross_layer(
    corrupted: int, kernel_faults: int, failed: int, mission_faults: int, confidence: float = 0.95
) -> CrossLayer:
    """Estimate the probability that a mission fails, given an SDC in a kernel.

    Both campaigns must sample the same population: the same kernel, level and sampling rule.

    Args:
        corrupted, kernel_faults: SDCs and injected faults of the isolated kernel (`mavfi kernels`).
        failed, mission_faults: missions that fail although their golden flights succeed, and the
            faults injected in missions.
    """
    corruption = wilson(corrupted, kernel_faults, confidence=confidence)
    failure = wilson(failed, mission_faults, confidence=confidence)
    ends = None
    if corrupted and failure.share <= corruption.share:
        value, low, high = (
            min(1.0, share / corruption.share)
            for share in (failure.share, failure.low, failure.high)
        )
        ends = value, low, high
    return CrossLayer(corruption, failure, ends)


# Clusters ---------------------------------------------------------------------------------------

Cluster = tuple[Hashable, Hashable]  # a stratum, and a group of similar runs within it
# Number of sampled clusters of each stratum, including those without a run.
Sampled = Mapping[Any, int]


def clustered_share(
    hits: Sequence[bool], clusters: Sequence[Cluster | None], sampled: Sampled
) -> Share:
    """Return the share of hits among runs that come in clusters, with its 95 % interval.

    Args:
        hits: whether each run is a hit.
        clusters: stratum and cluster of each run; None for a run that is its own cluster.
        sampled: number of sampled clusters of each stratum, including those without a run.
    """
    alone, spread = _spread(hits, clusters, sampled)
    freedom = [len(hits), *(number - 1 for number, _ in spread)]
    variances = [alone, *(variance for _, variance in spread)]
    wider = (_student(variances, freedom) / z_of(0.95)) ** 2 if spread else 1.0
    effect = wider * design_effect(hits, clusters, sampled)
    return wilson(sum(hits), len(hits), design_effect=effect)


def design_effect(
    hits: Sequence[bool], clusters: Sequence[Cluster | None], sampled: Sampled | None = None
) -> float:
    """Return the design effect of clusters on the share of hits, at least 1.

    It is the variance of the share, divided by its variance if all runs were independent.
    """
    share = sum(hits) / len(hits) if hits else 0.0
    if not 0.0 < share < 1.0:
        return 1.0
    alone, spread = _spread(hits, clusters, sampled or {})
    total = alone + sum(variance for _, variance in spread)
    return max(1.0, total / (len(hits) * share * (1.0 - share)))


def _spread(
    hits: Sequence[bool], clusters: Sequence[Cluster | None], sampled: Sampled
) -> tuple[float, list[tuple[int, float]]]:
    """Return the variance of the number of hits, split into independent contributions.

    The first value is the contribution of all runs without a cluster. Each entry of the list holds
    the number of clusters of a stratum, and the contribution of that stratum. The share is a ratio
    of two estimated totals (Cochran, sections 6.4 and 9A), so the residuals from the overall share
    are summed in each cluster. The spread of these sums shows how far the share would move if other
    clusters were drawn. It accounts for the similarity of a cluster's runs, the unequal sizes of
    clusters, and the error of the estimated weights of strata.
    """
    share = sum(hits) / len(hits) if hits else 0.0
    strata: dict[Hashable, dict[Hashable, float]] = {}
    alone = 0.0
    for hit, place in zip(hits, clusters, strict=True):
        if place is None:
            alone += (hit - share) ** 2
        else:
            sums = strata.setdefault(place[0], {})
            sums[place[1]] = sums.get(place[1], 0.0) + hit - share
    spread = []
    for stratum, sums in strata.items():
        number = max(2, len(sums), sampled.get(stratum, 0))
        mean = sum(sums.values()) / number
        squares = sum(residual**2 for residual in sums.values()) - number * mean**2
        spread.append((number, squares * number / (number - 1)))
    return alone, spread


def estimated_total(strata: Sequence[tuple[Sequence[float], int]]) -> Interval:
    """Estimate the sum of a value over all members of all strata, from a sample of each stratum.

    The members in a sample are drawn uniformly from their stratum.

    The interval has the correction for a finite population (Cochran, section 5.4). It is symmetric
    on a logarithmic scale, because window lengths are skewed. Its lower end is never below the
    observed total. If only one of a stratum's several members was drawn, the error is unknown and
    the upper end is infinite.

    Args:
        strata: for each stratum, the values of the drawn members, all above 0, and the number of
            all members.
    """
    total = seen = 0.0
    variances, freedom, drawn = [], [], sum(len(values) for values, _ in strata)
    for values, members in strata:
        n, own = len(values), math.fsum(values)
        total, seen = total + own / n * members, seen + own
        if n < members:
            squares = math.fsum((value - own / n) ** 2 for value in values)
            spread = squares / (n - 1) if n > 1 else math.inf
            variances.append(members * (members - n) / n * spread)
            freedom.append(n - 1)
    if math.inf in variances:
        return Interval(value=total, low=seen, high=math.inf, count=drawn)
    factor = math.exp(_student(variances, freedom) * math.sqrt(sum(variances)) / total)
    return Interval(value=total, low=max(seen, total / factor), high=total * factor, count=drawn)


def _student(variances: Sequence[float], freedom: Sequence[int]) -> float:
    """Return the 97.5 % quantile of Student's t, with Satterthwaite's degrees of freedom.

    Args:
        variances, freedom: the independent variances that are summed, and their degrees of freedom.
    """
    from scipy.special import stdtrit

    doubt = sum(own**2 / n for own, n in zip(variances, freedom, strict=True))
    return float(stdtrit(sum(variances) ** 2 / doubt, 0.975)) if doubt else z_of(0.95)
