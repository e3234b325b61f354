"""Receiver operating characteristic, precision and recall, over all thresholds.

A flight's score is the highest of its messages. A threshold t raises an alarm on
flights whose score is above t. Areas: under the ROC curve by the Mann-Whitney statistic, ties
halved, its interval from the variance of Hanley and McNeil (Radiology 143, 1982), taken at the end
of the interval and not at the estimate, so that an area of 1 has an interval too (method of
R. G. Newcombe, Statistics in Medicine 25, 2006); under the precision-recall curve by average
precision, the sum of precision times the gain in recall.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.shares import z_of

_HALVINGS = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class _Curves:
    """One detector's curves, in descending order of threshold, from one without alarms.

    Attributes:
        positives, negatives: flights with a harmful fault, and error-free flights.
        thresholds: (m,) in units of the detector's own; scores above are alarms.
        false_positive_rate: (m,) share of error-free flights with an alarm.
        recall: (m,) share of harmful faults with an alarm.
        precision: (m,) share of harmful faults among all flights with an alarm; 1 at the first.
        area, area_low, area_high: under the ROC curve, with its 95 % interval.
        average_precision: under the precision-recall curve; it depends on the mix of flights,
            chance is positives / (positives + negatives).
        operating_point: false positive rate and recall at the detector's own threshold.
    """

    positives: int
    negatives: int
    thresholds: list[float]
    false_positive_rate: list[float]
    recall: list[float]
    precision: list[float]
    area: float
    area_low: float
    area_high: float
    average_precision: float
    operating_point: tuple[float, float]


def curves(harmful: Sequence[float], error_free: Sequence[float]) -> _Curves:
    """Curves from scores in units of the threshold; empty unless both kinds have flights."""
    positive, negative = np.sort(np.asarray(harmful, np.float64)), np.sort(
        np.asarray(error_free, np.float64)
    )  # fmt: skip
    if not len(positive) or not len(negative):
        nan = math.nan
        return _Curves(
            positives=len(positive), negatives=len(negative), thresholds=[],
            false_positive_rate=[], recall=[], precision=[], area=nan, area_low=nan, area_high=nan,
            average_precision=nan, operating_point=(nan, nan),
        )  # fmt: skip
    levels = np.unique(np.concatenate([positive, negative]))[::-1]
    # At the n-th threshold, alarms are the flights whose score is at least the n-th level.
    hits = len(positive) - np.searchsorted(positive, levels, side="left")
    false = len(negative) - np.searchsorted(negative, levels, side="left")
    recall, fallout = hits / len(positive), false / len(negative)
    precision = hits / (hits + false)
    gains = np.diff(np.concatenate([[0.0], recall]))
    area = _area(positive, negative)
    low, high = _area_interval(area, len(positive), len(negative))
    below = np.concatenate([levels[1:], [-math.inf]])  # thresholds below each level
    return _Curves(
        positives=len(positive),
        negatives=len(negative),
        thresholds=[float(levels[0]), *below.tolist()],
        false_positive_rate=[0.0, *fallout.tolist()],
        recall=[0.0, *recall.tolist()],
        precision=[1.0, *precision.tolist()],
        area=area,
        area_low=low,
        area_high=high,
        average_precision=float((precision * gains).sum()),
        operating_point=(float((negative > 1.0).mean()), float((positive > 1.0).mean())),
    )


def _area(positive: FloatArray, negative: FloatArray) -> float:
    """Probability that a harmful fault scores higher than an error-free flight, ties halved."""
    below = np.searchsorted(negative, positive, side="left")
    not_above = np.searchsorted(negative, positive, side="right")
    return float((below + not_above).sum() / (2.0 * len(positive) * len(negative)))


def _area_interval(area: float, positives: int, negatives: int) -> tuple[float, float]:
    """Ends of the 95 % interval: areas whose own spread just reaches the estimate."""
    z = z_of(0.95)

    def spread(of: float) -> float:
        """Half width of the interval around an area (Hanley and McNeil 1982)."""
        q1, q2 = of / (2.0 - of), 2.0 * of**2 / (1.0 + of)
        variance = (
            of * (1.0 - of) + (positives - 1) * (q1 - of**2) + (negatives - 1) * (q2 - of**2)
        ) / (positives * negatives)
        return z * math.sqrt(max(0.0, variance))

    ends = []
    for far in (0.0, 1.0):
        near, outside = area, far
        for _ in range(_HALVINGS):
            middle = (near + outside) / 2.0
            if abs(middle - area) <= spread(middle):
                near = middle
            else:
                outside = middle
        ends.append(near)
    return ends[0], ends[1]
