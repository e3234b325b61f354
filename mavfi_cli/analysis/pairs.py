"""Two treatments of the same missions, row by row."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Sequence

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.flights import BoolArray, flags
from mavfi_cli.stats.bootstrap import RESAMPLES, Interval, interval
from mavfi_cli.stats.paired import McNemar, mcnemar


def paired(first: pa.Table, second: pa.Table, on: Sequence[str]) -> tuple[pa.Table, pa.Table]:
    """Join the rows of two tables by equal keys, in the order of the second.

    Args:
        on: names of the key columns; no two rows of `first` have the same keys.
    """
    if not (first.num_rows and second.num_rows):  # an empty column has no type to join by
        return first.slice(0, 0), second.slice(0, 0)
    there = first.select(on).append_column("first", pa.array(np.arange(first.num_rows)))
    here = second.select(on).append_column("second", pa.array(np.arange(second.num_rows)))
    places = here.join(there, list(on), join_type="inner", use_threads=False).sort_by("second")
    return first.take(places["first"]), second.take(places["second"])


def both_succeed(first: pa.Table, second: pa.Table) -> BoolArray:
    """Whether both flights of a pair reached the goal, (n,)."""
    return flags(first, "succeeded") & flags(second, "succeeded")


def success_test(first: pa.Table, second: pa.Table) -> McNemar:
    """McNemar's test of the success of these pairs."""
    return mcnemar(flags(first, "succeeded"), flags(second, "succeeded"))


def ratio(
    missions: Iterable[Hashable],
    first: Iterable[float],
    second: Iterable[float],
    resamples: int = RESAMPLES,
) -> Interval:
    """Geometric mean of second over first; its interval is that of the mean logarithm.

    Pairs with a value that is not positive are left out. Several pairs of one mission are not
    independent, so their mean counts as one value.

    Args:
        missions: key that dependent pairs share, (n,).
        first, second: values of each pair, (n,).
    """
    pairs = zip(missions, first, second, strict=True)
    logs = [(mission, math.log(b / a)) for mission, a, b in pairs if a > 0.0 and b > 0.0]
    found = interval(_means(logs), resamples=resamples)
    return Interval(
        value=math.exp(found.value),
        low=math.exp(found.low),
        high=math.exp(found.high),
        count=found.count,
    )


def difference(
    missions: Iterable[Hashable],
    first: Iterable[float],
    second: Iterable[float],
    resamples: int = RESAMPLES,
) -> Interval:
    """Mean of second minus first, for values that may be zero; otherwise as `ratio`."""
    pairs = zip(missions, first, second, strict=True)
    changes = [(mission, b - a) for mission, a, b in pairs if not math.isnan(b - a)]
    return interval(_means(changes), resamples=resamples)


def _means(values: Iterable[tuple[Hashable, float]]) -> list[float]:
    """The mean of each mission, in the order of first occurrence."""
    found: dict[Hashable, list[float]] = {}
    for mission, value in values:
        found.setdefault(mission, []).append(value)
    return [math.fsum(each) / len(each) for each in found.values()]
