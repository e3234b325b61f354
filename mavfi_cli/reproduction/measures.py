"""Numbers of a table of flights, as cells: success, means, worst cases."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import chosen, flags, known, numbers, paired
from mavfi_cli.analysis.groups import RESAMPLES
from mavfi_cli.core.types import FloatArray
from mavfi_cli.report.tables.paper_table import PaperCell, Printed
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.paired import OWN, WorstCase, worst_case
from mavfi_cli.stats.shares import Share, rate

PERCENT = 100.0


def golden(table: pa.Table) -> pa.Table:
    """The flights without fault and detector."""
    return chosen(table, level=None, detector=None)


def faulty(table: pa.Table, detector: str | None = None, **values: object) -> pa.Table:
    """The flights with a fault, without a detector or with this one."""
    return chosen(table.filter(pc.is_valid(table["level"])), detector=detector, **values)


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


def success(table: pa.Table, paper: Printed = None) -> PaperCell:
    """Success rate of all flown missions, in per cent, as the paper counts."""
    return share_cell(rate(int(flags(table, "succeeded").sum()), table.num_rows), paper)


def mean_cell(values: Sequence[float] | FloatArray, paper: Printed = None) -> PaperCell:
    """A mean with its bootstrap interval."""
    found = interval(values, resamples=RESAMPLES)
    return PaperCell(
        value=found.value, low=found.low, high=found.high, count=found.count, paper=paper
    )


def mean(table: pa.Table, name: str, paper: Printed = None, scale: float = 1.0) -> PaperCell:
    """Mean of a measure over the successful missions."""
    return mean_cell(scale * _of_successes(table, name), paper)


def _of_successes(table: pa.Table, name: str) -> FloatArray:
    """A measure of the successful missions that have it."""
    return known(numbers(chosen(table, succeeded=True), name))


def with_own(bare: pa.Table, flights: pa.Table) -> tuple[pa.Table, FloatArray]:
    """The flights that succeed as their golden flights do, and their time over that of these."""
    own, both = paired(chosen(bare, succeeded=True), chosen(flights, succeeded=True), ["pair"])
    return both, numbers(both, "flight_time_s") / numbers(own, "flight_time_s")


def over_own(bare: pa.Table, flights: pa.Table) -> FloatArray:
    """Flight times over those of the golden flights of the same missions, if both succeed."""
    return with_own(bare, flights)[1]


def worst_own(bare: pa.Table, flights: pa.Table, paper: Printed = None) -> PaperCell:
    """The largest increase over the own golden flight, in per cent: a maximum has no interval."""
    ratios = over_own(bare, flights)
    return maximum(PERCENT * (ratios - 1.0), paper)


def maximum(values: FloatArray, paper: Printed = None) -> PaperCell:
    """The largest value; it has no interval."""
    if not len(values):
        return PaperCell(paper=paper)
    return PaperCell(value=float(np.max(values)), count=len(values), paper=paper)


def worst_mean(bare: pa.Table, flights: pa.Table, paper: Printed = None) -> PaperCell:
    """The longest flight over the mean golden one, as increase in per cent."""
    golden_s, times_s = (
        _of_successes(bare, "flight_time_s"),
        _of_successes(flights, "flight_time_s"),
    )
    if not (len(golden_s) and len(times_s)):
        return PaperCell(paper=paper)
    increase = float(times_s.max() / golden_s.mean()) - 1.0
    return PaperCell(value=PERCENT * increase, count=len(times_s), paper=paper)


def recovery(bare: pa.Table, faults: pa.Table, protected: pa.Table) -> WorstCase:
    """The worst case over own golden flights, and what of it a protection recovers.

    Only faults count that were flown with the protection, too: of more flights the longest is
    longer.
    """
    both = _of_faults(faults, set(_faults(protected)))
    return worst_case(OWN, over_own(bare, both).tolist(), over_own(bare, protected).tolist())


_FAULT = ("pair", "level", "fault_target", "fault_seed", "fault_bits", "fault_field")


def _faults(table: pa.Table) -> list[tuple[object, ...]]:
    """What tells the fault of each flight from every other."""
    return list(zip(*(table[name].to_pylist() for name in _FAULT), strict=True))


def _of_faults(table: pa.Table, chosen: Collection[tuple[object, ...]]) -> pa.Table:
    return table.filter(pa.array([each in chosen for each in _faults(table)], pa.bool_()))


def recovered(
    bare: pa.Table,
    faults: pa.Table,
    protected: pa.Table,
    paper: Printed,
    measure: Callable[[WorstCase], float],
) -> PaperCell:
    """What a protection recovers of the worst case, in per cent or in points."""
    value = PERCENT * measure(recovery(bare, faults, protected))
    return PaperCell(
        value=value,
        count=0 if math.isnan(value) else len(over_own(bare, protected)),
        paper=paper,
    )
