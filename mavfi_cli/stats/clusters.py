"""Shares and totals from samples of clusters, with intervals that contain the sampling of clusters.

A run hits a cluster: a sampled window of executed instructions. Clusters are drawn uniformly from a
stratum, such as the windows that begin at one function. Both formulas are those of W. G. Cochran,
Sampling Techniques, 3rd edition, 1977. Few clusters tell their own spread badly. So the quantiles
are Student's, with the degrees of freedom of F. E. Satterthwaite (Biometrics Bulletin 2, 1946).
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mavfi_cli.stats.shares import Share, wilson

Cluster = tuple[Hashable, Hashable]  # a stratum, and a group of similar runs within it
# Sampled clusters of each stratum, those without a run included.
Sampled = Mapping[Any, int]
_NORMAL = 1.959963984540054


def clustered_share(
    hits: Sequence[bool], clusters: Sequence[Cluster | None], sampled: Sampled
) -> Share:
    """The share of hits with its 95 % interval.

    Args:
        clusters: stratum and cluster of each run; None for a run that stands for itself.
    """
    alone, spread = _spread(hits, clusters, sampled)
    freedom = [len(hits), *(number - 1 for number, _ in spread)]
    variances = [alone, *(variance for _, variance in spread)]
    wider = (_student(variances, freedom) / _NORMAL) ** 2 if spread else 1.0
    effect = wider * design_effect(hits, clusters, sampled)
    return wilson(sum(hits), len(hits), design_effect=effect)


def design_effect(
    hits: Sequence[bool], clusters: Sequence[Cluster | None], sampled: Sampled | None = None
) -> float:
    """Variance of a share over that of as many independent runs; at least 1."""
    share = sum(hits) / len(hits) if hits else 0.0
    if not 0.0 < share < 1.0:
        return 1.0
    alone, spread = _spread(hits, clusters, sampled or {})
    variance = alone + sum(each for _, each in spread)
    return max(1.0, variance / (len(hits) * share * (1.0 - share)))


def _spread(
    hits: Sequence[bool], clusters: Sequence[Cluster | None], sampled: Sampled
) -> tuple[float, list[tuple[int, float]]]:
    """Variance of the number of hits: of runs alone, and by stratum with its number of clusters.

    The share is a ratio of two estimated totals (Cochran, sections 6.4 and 9A). So the residuals of
    a cluster's runs against the share of the whole are summed. The spread of these sums tells how
    far the share would move with other clusters. It contains the likeness of a cluster's runs, the
    unequal sizes of clusters, and the error of the estimated weights of strata.
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
        squares = sum(each**2 for each in sums.values()) - number * mean**2
        spread.append((number, squares * number / (number - 1)))
    return alone, spread


@dataclass(frozen=True, slots=True, kw_only=True)
class Total:
    """A total that is estimated from samples, with its 95 % interval."""

    total: float
    low: float
    high: float


def estimated_total(strata: Sequence[tuple[Sequence[float], int]]) -> Total:
    """The total over strata, of each of which some members were drawn uniformly.

    The interval has the correction for a finite population (Cochran, section 5.4). It is that of
    the logarithm, because lengths of windows are skewed, and is not lower than what was seen. One
    member out of several does not tell its error, so there is no upper end.

    Args:
        strata: the values of the drawn members, all above 0, and the number of all members.
    """
    total = seen = 0.0
    variances, freedom = [], []
    for values, members in strata:
        n, own = len(values), math.fsum(values)
        total, seen = total + own / n * members, seen + own
        if n < members:
            squares = math.fsum((value - own / n) ** 2 for value in values)
            spread = squares / (n - 1) if n > 1 else math.inf
            variances.append(members * (members - n) / n * spread)
            freedom.append(n - 1)
    if math.inf in variances:
        return Total(total=total, low=seen, high=math.inf)
    factor = math.exp(_student(variances, freedom) * math.sqrt(sum(variances)) / total)
    return Total(total=total, low=max(seen, total / factor), high=total * factor)


def _student(variances: Sequence[float], freedom: Sequence[int]) -> float:
    """The 97.5 % quantile of Student's t for a sum of variances, each with degrees of freedom.

    By the series of Abramowitz and Stegun, 26.7.5: within 0.03 from three degrees on.
    """
    doubt = sum(own**2 / n for own, n in zip(variances, freedom, strict=True))
    if not doubt:
        return _NORMAL
    v, z = sum(variances) ** 2 / doubt, _NORMAL
    first = (z**3 + z) / (4 * v)
    second = (5 * z**5 + 16 * z**3 + 3 * z) / (96 * v**2)
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * v**3)
    return z + first + second + third
