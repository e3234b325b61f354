"""Receiver operating characteristic, precision and recall, over all thresholds.

A flight's score is the highest score of its messages. A threshold t raises an alarm on flights
whose score is above t. The area under the ROC curve is the Mann-Whitney statistic, in which a tie
counts one half. Its interval uses the variance of Hanley and McNeil (Radiology 143, 1982),
evaluated at each end of the interval instead of at the estimate, so that an area of 1 has an
interval too (R. G. Newcombe, Statistics in Medicine 25, 2006). The area under the precision-recall
curve is the average precision, the sum of precision times the gain in recall.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from mavfi_cli.stats.shares import z_of

_NEAR = 1e-9  # search offset from the area itself, because areas of 0 and 1 have no spread


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """The ROC and precision-recall curves of a detector over all thresholds, and their areas.

    Each curve has shape (m,), with one point per threshold. Thresholds are in units of the
    detector's own threshold. If there are no flights of one kind, harmful or error-free, the curves
    are empty and the numbers are NaN.

    Attributes:
        positives, negatives: number of harmful faults and of error-free flights with a score.
        thresholds: in descending order, beginning with one that raises no alarm.
        false_positive_rate: share of error-free flights with an alarm.
        recall: share of harmful faults with an alarm.
        precision: share of harmful faults among flights with an alarm; 1 at the first threshold.
        area, area_low, area_high: area under the ROC curve, and the ends of its 95 % interval.
        average_precision: area under the precision-recall curve. It depends on the mix of flights:
            for a detector that guesses, it is positives / (positives + negatives).
        operating_point: false positive rate and recall at the detector's own threshold.
    """

    positives: int
    negatives: int
    thresholds: list[float] = field(default_factory=list)
    false_positive_rate: list[float] = field(default_factory=list)
    recall: list[float] = field(default_factory=list)
    precision: list[float] = field(default_factory=list)
    area: float = math.nan
    area_low: float = math.nan
    area_high: float = math.nan
    average_precision: float = math.nan
    operating_point: tuple[float, float] = (math.nan, math.nan)

    @classmethod
    def of(cls, harmful: Sequence[float], error_free: Sequence[float], **more: Any) -> Self:
        """Compute the curves from the scores of harmful faults and of error-free flights.

        Args:
            harmful, error_free: one score per flight, in units of the detector's own threshold.
            more: additional fields of a subclass.
        """
        from scipy.stats import rankdata

        positive, negative = (np.sort(np.asarray(s, np.float64)) for s in (harmful, error_free))
        positives, negatives = len(positive), len(negative)
        if not positives or not negatives:
            return cls(positives=positives, negatives=negatives, **more)
        levels = np.unique(np.concatenate([positive, negative]))[::-1]
        # At the n-th threshold, alarms are the flights whose score is at least the n-th level.
        hits = positives - np.searchsorted(positive, levels, side="left")
        false = negatives - np.searchsorted(negative, levels, side="left")
        recall, precision = hits / positives, hits / (hits + false)
        below = np.concatenate([levels[1:], [-math.inf]])  # thresholds below each level
        # The probability that a harmful fault scores higher than an error-free flight, ties halved.
        ranks = rankdata(np.concatenate([positive, negative]))[:positives]
        above = float(ranks.sum()) - positives * (positives + 1) / 2.0  # Mann-Whitney's U
        area = above / (positives * negatives)
        low, high = _area_interval(area, positives, negatives)
        return cls(
            positives=positives,
            negatives=negatives,
            thresholds=[float(levels[0]), *below.tolist()],
            false_positive_rate=[0.0, *(false / negatives).tolist()],
            recall=[0.0, *recall.tolist()],
            precision=[1.0, *precision.tolist()],
            area=area,
            area_low=low,
            area_high=high,
            average_precision=float((precision * np.diff(recall, prepend=0.0)).sum()),
            operating_point=(float((negative > 1.0).mean()), float((positive > 1.0).mean())),
            **more,
        )


def _area_interval(area: float, positives: int, negatives: int) -> tuple[float, float]:
    """Return the ends of the 95 % confidence interval of an area under the ROC curve.

    An end is the area whose own interval just reaches `area`.
    """
    from scipy.optimize import brentq

    z = z_of(0.95)

    def spread(of: float) -> float:
        """Return the half width of the interval around an area (Hanley and McNeil 1982)."""
        q1, q2 = of / (2.0 - of), 2.0 * of**2 / (1.0 + of)
        variance = (
            of * (1.0 - of) + (positives - 1) * (q1 - of**2) + (negatives - 1) * (q2 - of**2)
        ) / (positives * negatives)
        return z * math.sqrt(max(0.0, variance))

    low, high = (
        float(brentq(lambda of: abs(of - area) - spread(of), area + _NEAR * (far - area), far))
        for far in (0.0, 1.0)
    )
    return low, high
