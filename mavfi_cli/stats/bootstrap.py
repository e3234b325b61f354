"""Bootstrap intervals of flight time, distance, energy, replans, and of their paired differences.

BCa: bias-corrected and accelerated (B. Efron, JASA 82, 1987). It is seeded, so the same numbers
give the same interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.shares import Interval, z_of

RESAMPLES = 9999
FEW = 10  # with fewer values a 95 % interval covers the true mean in less than 90 % of cases
LARGE = 500  # from here on the mean is normal and the bootstrap would only be slow
BLOCKS = 2000  # with more values whole blocks are left out in turn
_CHUNK = 4_000_000  # numbers drawn at once
IntArray = NDArray[np.int64]
Statistic = Callable[[FloatArray], FloatArray]  # (..., n) -> (...)


def mean(values: FloatArray) -> FloatArray:
    """Reduce the last axis."""
    return np.asarray(values.mean(axis=-1))


def median(values: FloatArray) -> FloatArray:
    """Reduce the last axis."""
    return np.asarray(np.median(values, axis=-1))


def interval(
    values: Sequence[float] | FloatArray,
    statistic: Statistic = mean,
    *,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 1,
) -> Interval:
    """A statistic with its BCa interval, or the normal one for the mean of LARGE samples.

    Args:
        values: (n,) one value per mission; the differences for a paired difference.
        statistic: reduces the last axis of an array.
    """
    sample = np.asarray(values, dtype=np.float64)
    if len(sample) == 0:
        return Interval(value=math.nan, low=math.nan, high=math.nan, count=0)
    value = float(statistic(sample))
    if len(sample) == 1 or float(np.ptp(sample)) == 0.0:
        spread = math.nan if len(sample) == 1 else value
        return Interval(value=value, low=spread, high=spread, count=len(sample))
    if statistic is mean and len(sample) >= LARGE:
        half = z_of(confidence) * float(sample.std(ddof=1)) / math.sqrt(len(sample))
        return Interval(value=value, low=value - half, high=value + half, count=len(sample))
    drawn = _resampled(sample, statistic, resamples, seed)
    low, high = np.quantile(drawn, _levels(sample, statistic, drawn, value, confidence))
    return Interval(value=value, low=float(low), high=float(high), count=len(sample))


def _resampled(sample: FloatArray, statistic: Statistic, resamples: int, seed: int) -> FloatArray:
    rng = np.random.Generator(np.random.PCG64(seed))
    rows = max(1, _CHUNK // len(sample))
    parts = [
        statistic(
            sample[rng.integers(len(sample), size=(min(rows, resamples - done), len(sample)))]
        )
        for done in range(0, resamples, rows)
    ]
    return np.concatenate(parts)


def _levels(
    sample: FloatArray, statistic: Statistic, drawn: FloatArray, value: float, confidence: float
) -> list[float]:
    """The quantiles of the resampled statistic that are the ends of the interval."""
    normal = NormalDist()
    counted = int(np.count_nonzero(drawn < value)) + int(np.count_nonzero(drawn <= value))
    least = 1.0 / (len(drawn) + 1)  # the quantile of 0 or 1 is infinite
    bias = normal.inv_cdf(min(max(counted / (2 * len(drawn)), least), 1.0 - least))
    left_out = _left_out(sample, statistic)
    centred = left_out.mean() - left_out
    scale = float((centred**2).sum()) ** 1.5
    acceleration = float((centred**3).sum()) / (6.0 * scale) if scale > 0.0 else 0.0
    levels = []
    for z in (-z_of(confidence), z_of(confidence)):
        shifted = bias + z
        levels.append(normal.cdf(bias + shifted / (1.0 - acceleration * shifted)))
    return levels


def _left_out(sample: FloatArray, statistic: Statistic) -> FloatArray:
    """The statistic without each value in turn, or without each of BLOCKS blocks if many."""
    if statistic is mean:
        return np.asarray((sample.sum() - sample) / (len(sample) - 1))
    blocks = np.array_split(np.arange(len(sample)), min(len(sample), BLOCKS))
    return np.array([float(statistic(np.delete(sample, block))) for block in blocks])


def interval_of_rows(
    count: int, statistic: Callable[[IntArray], FloatArray], *, resamples: int
) -> Interval:
    """A statistic of several columns with its interval, by resampling their rows together.

    Args:
        statistic: takes row indices (..., n) and reduces the last axis.
    """
    return interval(
        np.arange(count, dtype=np.float64),
        lambda rows: statistic(rows.astype(np.int64)),
        resamples=resamples,
    )
