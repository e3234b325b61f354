"""Numbers of a table of flights, as cells: success, means, worst cases."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.flights import chosen, known, numbers
from mavfi_cli.analysis.groups import RESAMPLES
from mavfi_cli.core.types import FloatArray
from mavfi_cli.report.tables.paper_table import PaperCell, Printed
from mavfi_cli.reproduction.flights import ratios, share
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.paired import OWN, worst_case
from mavfi_cli.stats.shares import Share

PERCENT = 100.0


def share_cell(share: Share, paper: Printed = None) -> PaperCell:
    """A share as per cent."""
    if not share.total:
        return PaperCell(paper=paper)
    return PaperCell(
        value=PERCENT * share.share,
        low=PERCENT * share.low,
        high=PERCENT * share.high,
        count=share.total,
        paper=paper,
    )


def success(flights: pa.Table, paper: Printed = None) -> PaperCell:
    """Success rate of all flown missions, in per cent, as the paper counts."""
    return share_cell(share(flights, value=False), paper)


def mean_cell(values: Sequence[float] | FloatArray, paper: Printed = None) -> PaperCell:
    """A mean with its bootstrap interval."""
    found = interval(values, resamples=RESAMPLES)
    return PaperCell(
        value=found.value, low=found.low, high=found.high, count=found.count, paper=paper
    )


def mean(flights: pa.Table, name: str, paper: Printed = None, scale: float = 1.0) -> PaperCell:
    """Mean of a measure over the successful missions."""
    return mean_cell(scale * _of_successes(flights, name), paper)


def _of_successes(flights: pa.Table, name: str) -> FloatArray:
    """A measure of the successful missions that have it."""
    return known(numbers(chosen(flights, lost=False), name))


def maximum(values: FloatArray, paper: Printed = None) -> PaperCell:
    """The largest value; it has no interval."""
    if not len(values):
        return PaperCell(paper=paper)
    return PaperCell(value=float(np.max(values)), count=len(values), paper=paper)


def increases(flights: pa.Table) -> FloatArray:
    """Flight times beyond those of the own golden flights, in per cent, where both succeed."""
    return PERCENT * (ratios(flights) - 1.0)


def worst_mean(bare: pa.Table, flights: pa.Table, paper: Printed = None) -> PaperCell:
    """The longest flight over the mean golden one, as increase in per cent."""
    golden_s, times_s = (_of_successes(each, "flight_time_s") for each in (bare, flights))
    if not (len(golden_s) and len(times_s)):
        return PaperCell(paper=paper)
    increase = float(times_s.max() / golden_s.mean()) - 1.0
    return PaperCell(value=PERCENT * increase, count=len(times_s), paper=paper)


def recovered(protected: pa.Table, measure: str, paper: Printed) -> PaperCell:
    """What a protection recovers of the worst case, in per cent or in points.

    The worst case is that of the faults that were flown with the protection, too: of more flights
    the longest is longer.

    Args:
        measure: field of `WorstCase`.
    """
    bare, own = known(numbers(protected, "bare_over_own")), ratios(protected)
    value = PERCENT * getattr(worst_case(OWN, bare.tolist(), own.tolist()), measure)
    return PaperCell(value=value, count=0 if math.isnan(value) else len(own), paper=paper)
