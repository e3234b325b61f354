"""Comparison of two treatments: tests, the worst case, and effects with their intervals.

The worst case and its recovery follow the paper's section VII-A. For Factory, that section reports
a worst-case flight time with faults that is 73.8 % above the golden run's. The recovery is 64.2 %
in section VII-A and 87.1 % in Fig. 14. Because 64.2 / 73.8 = 87.0 %, the first number must be in
percentage points of the golden run, and the second must be a share of the increase. Both are
computed here.

An effect is a single number that summarises a comparison: the difference of two rates, or the share
of a loss that protection recovers.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.shares import NO_INTERVAL, Interval, z_of

BoolArray = NDArray[np.bool_]
OWN = (1.0,)  # `golden` of `WorstCase.of` if each value is relative to its own golden flight
_PATTERNS = 9999  # maximum number of sign patterns in `sign_flips`
_CHUNK = 1_000_000  # signs drawn at once; larger arrays leave the processor's cache
_DIGITS = 9  # decimals to which relative sums are compared; equal ones may differ by rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class McNemar:
    """McNemar's test of two treatments: counts of pairs by which treatment succeeded, and p-value.

    Attributes:
        both, neither: number of pairs in which both treatments succeeded, or neither.
        only_first, only_second: number of pairs in which only that treatment succeeded.
        p_value: two-sided p-value of equal success rates; see `of`.
        difference: success rate under the second treatment minus that under the first, weighted in
            a stratified sample; NaN without pairs.
    """

    both: int
    only_first: int
    only_second: int
    neither: int
    p_value: float
    difference: float

    @staticmethod
    def of(
        first: Sequence[bool] | BoolArray,
        second: Sequence[bool] | BoolArray,
        *,
        weights: FloatArray | None = None,
        clusters: NDArray[np.int64] | None = None,
    ) -> McNemar:
        """Run McNemar's exact test on the same missions under two treatments.

        If the treatments are equally good, each pair with different outcomes is a fair coin toss
        (Psychometrika 12, 1947). With weights, the p-value is that of `sign_flips` for the weighted
        differences. With clusters, it is that of `sign_flips` for the sums of the differences in
        each cluster.

        Args:
            first, second: success of each mission under each treatment, (n,).
            weights: (n,) weights of a stratified sample; None for equal weights.
            clusters: (n,) the cluster of each mission; None for independent missions.

        Raises:
            ValueError: both weights and clusters are given.
        """
        from scipy.stats import binomtest

        if weights is not None and clusters is not None:
            raise ValueError("weights cannot be combined with clusters")

        ends = 2 * np.asarray(first, dtype=np.int64) + np.asarray(second, dtype=np.int64)
        neither, only_second, only_first, both = np.bincount(ends, minlength=4).tolist()
        differing = only_first + only_second
        p_value = float(binomtest(only_first, differing).pvalue) if differing else 1.0
        changes = np.asarray(second, np.int64) - np.asarray(first, np.int64)
        test = McNemar(
            both=both,
            only_first=only_first,
            only_second=only_second,
            neither=neither,
            p_value=p_value,
            difference=float(np.average(changes, weights=weights)) if len(changes) else math.nan,
        )
        if clusters is not None and len(changes):
            sums = np.bincount(np.unique(clusters, return_inverse=True)[1], changes)
            return replace(test, p_value=sign_flips(sums.tolist()))
        if weights is None:
            return test
        return replace(test, p_value=sign_flips((weights * changes).tolist()))

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return self.both + self.only_first + self.only_second + self.neither


def sign_flips(differences: Sequence[float]) -> float:
    """Return the two-sided p-value of Fisher's randomisation test of paired differences.

    Without an effect, a difference is equally likely to have either sign. The test assumes no
    distribution, so it stays valid if most differences are zero, where bootstrap intervals are too
    narrow (R. A. Fisher, The Design of Experiments, 1935, section 21). It tries all sign patterns
    if there are at most _PATTERNS; otherwise it tries _PATTERNS random ones from a fixed seed.

    Args:
        differences: one for each independent pair; zeros do not change the result.

    Returns:
        The p-value; 1 if at most one difference is not zero.
    """
    from scipy.stats import permutation_test

    values = np.array([difference for difference in differences if difference != 0.0])
    if len(values) < 2:
        return 1.0
    scale = float(np.abs(values).sum())
    result = permutation_test(
        (values,),
        lambda flipped, axis: np.round(np.abs(flipped.sum(axis)) / scale, _DIGITS),
        permutation_type="samples", alternative="greater", vectorized=True,
        n_resamples=_PATTERNS, batch=max(1, _CHUNK // len(values)), rng=np.random.default_rng(1),
    )  # fmt: skip
    return float(result.pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return the p-values of a family of tests, corrected by Holm's method.

    The method is that of S. Holm, Scand. J. Statistics 6, 1979. The values keep their order. Reject
    a hypothesis if its corrected value is below the level.
    """
    count = len(p_values)
    corrected = [0.0] * count
    highest = 0.0
    for rank, index in enumerate(sorted(range(count), key=lambda i: p_values[i])):
        highest = max(highest, min(1.0, (count - rank) * p_values[index]))
        corrected[index] = highest
    return corrected


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstCase:
    """The worst-case flight time or energy with faults, and the part that protection recovers.

    Only successful flights count. All attributes are NaN without golden or faulty flights.

    Attributes:
        golden: the reference, which is the mean of the golden flights.
        golden_worst, faulty_worst, protected_worst: the largest value without faults, with faults,
            and with faults and protection.
        increase: faulty worst case divided by the reference, minus 1; 0.738 for Factory.
        recovered: reduction by protection, divided by the reference; 0.642 for Factory.
        recovered_share: `recovered` / `increase`, 0.87 for Factory; NaN unless the faulty worst
            case exceeds the worst golden one.
    """

    golden: float
    golden_worst: float
    faulty_worst: float
    protected_worst: float
    increase: float
    recovered: float
    recovered_share: float

    @classmethod
    def of(
        cls, golden: Sequence[float], faulty: Sequence[float], protected: Sequence[float] = ()
    ) -> WorstCase:
        """Compare the worst flight times or energies of three settings.

        Args:
            golden, faulty, protected: values of the successful missions without faults, with
                faults, and with faults and protection. `golden` is OWN if the other values are
                already divided by those of their missions' golden flights.
        """
        known = bool(golden and faulty)
        reference = math.fsum(golden) / len(golden) if known else math.nan
        worst, faulty_worst, protected_worst = (
            max(values, default=math.nan) if known else math.nan
            for values in (golden, faulty, protected)
        )
        increase = faulty_worst / reference - 1.0
        recovered = (faulty_worst - protected_worst) / reference
        return cls(
            golden=reference,
            golden_worst=worst,
            faulty_worst=faulty_worst,
            protected_worst=protected_worst,
            increase=increase,
            recovered=recovered,
            recovered_share=recovered / increase if faulty_worst > worst else math.nan,
        )


# Effects ------------------------------------------------------------------------------------------

DRAWS = 100_000  # of each rate in `recovered_share` and `net_share`
Count = tuple[int, int]  # successes, missions


def paired_difference(
    first: Sequence[bool] | BoolArray,
    second: Sequence[bool] | BoolArray,
    clusters: Sequence[Hashable],
) -> Interval:
    """Return the hit rate of the second treatment minus that of the first, on the same missions.

    The interval is that of D. G. Bonett and R. M. Price (J. Educational and Behavioral Statistics
    37, 2012): one pair is added to each of the two kinds of differing pairs, so the interval has a
    width even if no pair differs. The number of pairs is divided by the design effect of the
    clusters. The result is NaN without missions.

    Args:
        first, second: whether each mission is a hit under each treatment, (n,).
        clusters: key shared by the missions that depend on each other, (n,).
    """
    change = np.asarray(second, dtype=np.int64) - np.asarray(first, dtype=np.int64)
    pairs = len(change)
    if not pairs:
        return NO_INTERVAL
    effective = pairs / _cluster_effect(change, clusters)
    gained, lost = (
        (effective * float(np.mean(change == sign)) + 1.0) / (effective + 2.0) for sign in (1, -1)
    )
    centre = gained - lost
    half = z_of(0.95) * math.sqrt((gained + lost - centre**2) / (effective + 2.0))
    return Interval(
        value=float(change.mean()),
        low=max(-1.0, centre - half),
        high=min(1.0, centre + half),
        count=pairs,
    )


def net_share(
    before: BoolArray, after: BoolArray, clusters: Sequence[Hashable], *, seed: int = 1
) -> Interval:
    """Return the net reduction in hits by a treatment, as a share of the hits without it.

    It is (hits before - hits after) / hits before on the same missions. It is below 0 if the
    treatment causes more hits than it undoes, and NaN if there are no hits before. The ends of the
    interval are percentiles of random draws. Each draw takes three shares from their posterior
    distributions under Jeffreys' prior: missions that are hits before, hits that are undone, and
    other missions that become hits. The numbers of missions are divided by the design effect of the
    clusters.

    Args:
        before, after: whether each mission is a hit without and with the treatment, (n,).
        clusters: key shared by the missions that depend on each other, (n,).
    """
    hits, pairs = int(before.sum()), len(before)
    if not hits:
        return NO_INTERVAL
    undone, caused = int((before & ~after).sum()), int((~before & after).sum())
    change = after.astype(np.int64) - before.astype(np.int64)
    effect = _cluster_effect(change, clusters)
    rng = np.random.default_rng(seed)
    hit, back, new = (
        rng.beta(count / effect + 0.5, (total - count) / effect + 0.5, DRAWS)
        for count, total in ((hits, pairs), (undone, hits), (caused, pairs - hits))
    )
    low, high = np.percentile(back - new * (1.0 - hit) / hit, [2.5, 97.5])
    value = (undone - caused) / hits
    # A share at an end of its range lies outside the percentiles of a continuous posterior.
    return Interval(
        value=value, low=min(value, float(low)), high=max(value, float(high)), count=pairs
    )


def _cluster_effect(values: NDArray[np.int64], clusters: Sequence[Hashable]) -> float:
    """Return the design effect of clusters on the mean of `values`, at least 1.

    It is the variance of the mean, divided by its variance if the values were independent.
    """
    residuals = values - values.mean()
    squares = float((residuals**2).sum())
    sums: dict[Hashable, float] = {}
    for key, residual in zip(clusters, residuals.tolist(), strict=True):
        sums[key] = sums.get(key, 0.0) + residual
    if squares == 0.0 or len(sums) in (1, len(values)):
        return 1.0
    between = math.fsum(total**2 for total in sums.values()) * len(sums) / (len(sums) - 1)
    return max(1.0, between / squares)


def recovered_share(
    golden: Count, faulty: Count, protected: Count, *, draws: int = DRAWS, seed: int = 1
) -> Interval:
    """Return the share of a loss in success rate that protection recovers.

    It is (protected - faulty) / (golden - faulty), a ratio of two differences of independent
    success rates. The value is NaN if the faults cost nothing. The three rates are drawn from their
    posterior distributions under Jeffreys' prior, Beta(wins + 1/2, losses + 1/2), so that even a
    rate of 100 out of 100 varies. The ends of the interval are percentiles of the ratio, including
    draws in which the faults cost nothing.

    Args:
        golden, faulty, protected: number of successes and number of missions without faults, with
            faults, and with faults and protection.
    """
    rng = np.random.default_rng(seed)
    drawn = [
        rng.beta(wins + 0.5, missions - wins + 0.5, draws)
        for wins, missions in (golden, faulty, protected)
    ]
    low, high = np.percentile((drawn[2] - drawn[1]) / (drawn[0] - drawn[1]), [2.5, 97.5])
    rates = [wins / missions for wins, missions in (golden, faulty, protected)]
    loss = rates[0] - rates[1]
    value = (rates[2] - rates[1]) / loss if loss else math.nan
    return Interval(value=value, low=float(low), high=float(high), count=faulty[1])
