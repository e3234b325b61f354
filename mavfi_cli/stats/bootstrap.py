"""Bootstrap intervals of flight time, distance, energy, replans and their paired differences.

SciPy resamples with a fixed seed, so equal values give equal intervals.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.shares import NO_INTERVAL, Interval, z_of

RESAMPLES = 9999
TABLE_RESAMPLES = 1999  # for the many intervals of a table
FEW = 10  # with fewer values a 95 % interval covers the true mean in less than 90 % of cases
LARGE = 500  # with this many values the mean is nearly normal, and a bootstrap is only slower
_CHUNK = 4_000_000  # numbers drawn at once
IntArray = NDArray[np.int64]
Statistic = Callable[[FloatArray], FloatArray]  # (..., n) -> (...)


def mean(values: FloatArray) -> FloatArray:
    """Return the mean over the last axis."""
    return np.asarray(values.mean(axis=-1))


def median(values: FloatArray) -> FloatArray:
    """Return the median over the last axis."""
    return np.asarray(np.median(values, axis=-1))


def interval(
    values: Sequence[float] | FloatArray,
    statistic: Statistic = mean,
    *,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 1,
    weights: FloatArray | None = None,
) -> Interval:
    """Return a statistic of a sample with its bootstrap confidence interval.

    The interval is BCa (bias-corrected and accelerated; B. Efron, JASA 82, 1987). It is the
    percentile interval if BCa is not defined, as for the median of tied values, or if there are
    more values than resamples, because BCa leaves out each value in turn. The mean of LARGE or more
    equally weighted values has a normal interval instead. The result is NaN without values. The
    ends of the interval are NaN for a single value.

    Args:
        values: (n,) one value per mission; for paired differences, one difference per mission.
        statistic: reduces the last axis of an array.
        weights: (n,) weights of a stratified sample, for the mean only; None for equal weights.

    Raises:
        ValueError: the weights are unequal, and the statistic is not the mean.
    """
    sample = np.asarray(values, dtype=np.float64)
    count = len(sample)
    if weights is not None and len(set(weights.tolist())) > 1:
        if statistic is not mean:
            raise ValueError("unequal weights can be used with the mean only")
        rows = partial(_weighted_mean, sample, weights)
        return interval_of_rows(count, rows, resamples=resamples, confidence=confidence, seed=seed)
    if count == 0:
        return NO_INTERVAL
    value = low = high = float(statistic(sample))
    if count == 1:
        low = high = math.nan
    elif float(np.ptp(sample)) != 0.0:
        if statistic is mean and count >= LARGE:
            half = z_of(confidence) * float(sample.std(ddof=1)) / math.sqrt(count)
            low, high = value - half, value + half
        else:
            low, high = _resampled(sample, statistic, confidence, resamples, seed)
    return Interval(value=value, low=low, high=high, count=count)


def _resampled(
    sample: FloatArray, statistic: Statistic, confidence: float, resamples: int, seed: int
) -> tuple[float, float]:
    """Return the ends of the BCa interval, or of the percentile interval if BCa is unsuitable."""
    from scipy.stats import DegenerateDataWarning, bootstrap

    result, ends = None, (math.nan, math.nan)
    for method in ("BCa", "percentile")[len(sample) > resamples :]:
        with warnings.catch_warnings(), np.errstate(divide="ignore", invalid="ignore"):
            warnings.simplefilter("ignore", DegenerateDataWarning)
            result = bootstrap(
                (sample,), lambda drawn, **_axis: statistic(drawn), vectorized=True,
                method=method, confidence_level=confidence,
                n_resamples=0 if result else resamples, bootstrap_result=result,
                batch=max(1, _CHUNK // len(sample)), rng=np.random.default_rng(seed),
            )  # fmt: skip
        ends = float(result.confidence_interval.low), float(result.confidence_interval.high)
        if not any(map(math.isnan, ends)):
            break
    return ends


def _weighted_mean(values: FloatArray, weights: FloatArray, rows: IntArray) -> FloatArray:
    return np.asarray((values * weights)[rows].sum(axis=-1) / weights[rows].sum(axis=-1))


def interval_of_rows(
    count: int,
    statistic: Callable[[IntArray], FloatArray],
    *,
    resamples: int,
    confidence: float = 0.95,
    seed: int = 1,
) -> Interval:
    """Return a statistic of a table with its bootstrap interval, resampling whole rows.

    Args:
        count: number of rows, n.
        statistic: maps row indices of shape (..., n) to the statistic of these rows, of shape
            (...); it has access to the columns itself.
    """
    return interval(
        np.arange(count, dtype=np.float64),
        lambda rows: statistic(rows.astype(np.int64)),
        resamples=resamples,
        confidence=confidence,
        seed=seed,
    )
