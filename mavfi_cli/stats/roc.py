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
from typing import Any

import numpy as np

from mavfi_cli.stats.shares import z_of

_NEAR = 1e-9  # areas of 0 and 1 have no spread, so their far ends are searched from beside them


def curves(harmful: Sequence[float], error_free: Sequence[float]) -> dict[str, Any]:
    """Curves from scores in units of the threshold; empty unless both kinds have flights.

    Returns:
        `positives`, `negatives`: number of scores of each kind. In descending order of threshold,
        from one without alarms, (m,) each: `thresholds`; `false_positive_rate`, the share of
        error-free flights with an alarm; `recall`, that of harmful faults; `precision`, the share
        of harmful faults among all with an alarm, 1 at the first. `area`, `area_low`, `area_high`:
        under the ROC curve, with its 95 % interval. `average_precision`: under the precision-recall
        curve; it depends on the mix of flights, chance is positives / (positives + negatives).
        `operating_point`: false positive rate and recall at the detector's own threshold.
    """
    from scipy.stats import rankdata

    positive, negative = (np.sort(np.asarray(s, np.float64)) for s in (harmful, error_free))
    found: dict[str, Any] = {"positives": len(positive), "negatives": len(negative)}
    if not len(positive) or not len(negative):
        lists = ("thresholds", "false_positive_rate", "recall", "precision")
        numbers = ("area", "area_low", "area_high", "average_precision")
        found |= {name: [] for name in lists} | dict.fromkeys(numbers, math.nan)
        return {**found, "operating_point": (math.nan, math.nan)}
    levels = np.unique(np.concatenate([positive, negative]))[::-1]
    # At the n-th threshold, alarms are the flights whose score is at least the n-th level.
    hits = len(positive) - np.searchsorted(positive, levels, side="left")
    false = len(negative) - np.searchsorted(negative, levels, side="left")
    recall, precision = hits / len(positive), hits / (hits + false)
    below = np.concatenate([levels[1:], [-math.inf]])  # thresholds below each level
    # The probability that a harmful fault scores higher than an error-free flight, ties halved.
    ranks = rankdata(np.concatenate([positive, negative]))[: len(positive)]
    above = float(ranks.sum()) - len(positive) * (len(positive) + 1) / 2.0  # Mann-Whitney's U
    area = above / (len(positive) * len(negative))
    low, high = _area_interval(area, len(positive), len(negative))
    return {
        **found,
        "thresholds": [float(levels[0]), *below.tolist()],
        "false_positive_rate": [0.0, *(false / len(negative)).tolist()],
        "recall": [0.0, *recall.tolist()],
        "precision": [1.0, *precision.tolist()],
        "area": area,
        "area_low": low,
        "area_high": high,
        "average_precision": float((precision * np.diff(recall, prepend=0.0)).sum()),
        "operating_point": (float((negative > 1.0).mean()), float((positive > 1.0).mean())),
    }


def _area_interval(area: float, positives: int, negatives: int) -> tuple[float, float]:
    """Ends of the 95 % interval: areas whose own spread just reaches the estimate."""
    from scipy.optimize import brentq

    z = z_of(0.95)

    def spread(of: float) -> float:
        """Half width of the interval around an area (Hanley and McNeil 1982)."""
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
