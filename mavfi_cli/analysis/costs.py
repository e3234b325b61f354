"""The cost of faults on each platform, and the worst cases: Fig. 16 of the paper.

The cost of a fault is the flight time over that of the golden flight of the same mission on the
same platform, if both reached the goal. It extends the measure of the paper, which flies one fixed
world, to several worlds. The longest flight over the mean golden flight is also given. It depends
on the length of the mission.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import chosen, numbers
from mavfi_cli.analysis.groups import RESAMPLES
from mavfi_cli.analysis.pairs import paired
from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.bootstrap import interval_of_rows
from mavfi_cli.stats.paired import sign_flips
from mavfi_cli.stats.worst_case import worst_case, worst_over_own

LATE = 0.95  # quantile given with the worst case, which has no interval
MISSION = ("seed", "target")  # columns that identify a mission on all platforms
_SAME_S = 1e-6  # flight times this close are equal: a tick is 20 ms


@dataclass(frozen=True, slots=True, kw_only=True)
class Struck:
    """The counted flights of a platform and setting, with their own golden flights.

    Attributes:
        costs: one row per pair that reached the goal: `seed`, `target`, `fault_seed`, `cost_s`,
            `over_own`.
        lost: flights that failed where the golden one reached the goal.
        longest_s: longest flight that reached the goal, whether or not the golden one did.
    """

    costs: pa.Table
    lost: int
    longest_s: float

    @property
    def worst(self) -> dict[str, Any] | None:
        """The row with the largest ratio to its golden flight; the lowest seed of equal ones."""
        rows = self.costs.sort_by([("over_own", "descending"), ("seed", "ascending")])
        return rows.slice(0, 1).to_pylist()[0] if rows.num_rows else None

    def largest(self, measure: str) -> float:
        """Largest value of a column; NaN without pairs."""
        found = pc.max(self.costs[measure]).as_py()
        return math.nan if found is None else float(found)


def struck(golden: pa.Table, counted: pa.Table) -> Struck:
    """Compare flights with the golden flights of the same missions.

    Args:
        golden: successful golden flights.
        counted: counted flights of one platform and setting.
    """
    own, known = paired(golden, counted, ["seed"])
    won = known["succeeded"]
    own, pairs = own.filter(won), known.filter(won)
    own_s, time_s = numbers(own, "flight_time_s"), numbers(pairs, "flight_time_s")
    costs = pairs.select([*MISSION, "fault_seed"])
    return Struck(
        costs=costs.append_column("cost_s", pa.array(time_s - own_s)).append_column(
            "over_own", pa.array(time_s / own_s)
        ),
        lost=known.num_rows - pairs.num_rows,
        longest_s=max(
            numbers(chosen(counted, succeeded=True), "flight_time_s").tolist(), default=math.nan
        ),
    )


def cost_row(
    platform: str, setting: str, found: Struck, faults: Struck, *, protected: bool
) -> dict[str, Any]:
    """The cost of a setting's faults on a platform.

    Args:
        faults: the same without a detector on this platform, the reference of recovery.
        protected: whether the setting has a detector.

    Returns:
        `cost_s`: mean with its interval and the largest; `over_own`: the 95th percentile with its
        interval and the largest. Several faults of one mission are no independent samples:
        intervals draw missions. `recovered_share` is the part of the largest increase without
        detector that is gone, not a number where there is none.
    """
    cost_s, over_own = (_by_mission(found.costs, name) for name in ("cost_s", "over_own"))
    worst, bare = found.largest("over_own"), faults.largest("over_own")
    flight, count = found.worst, len(cost_s)
    return {
        "platform": platform,
        "setting": setting,
        "pairs": found.costs.num_rows,
        "lost": found.lost,
        "cost_s": {
            "mean": _over(count, lambda drawn: _mean(cost_s[drawn])),
            "largest": found.largest("cost_s"),
        },
        "over_own": {
            "p95": _over(count, lambda drawn: _late(over_own[drawn])),
            "largest": worst,
            "recovered_share": worst_over_own([bare], [worst]).recovered_share
            if protected
            else math.nan,
        },
        "worst_flight": flight and {name: flight[name] for name in (*MISSION, "fault_seed")},
    }


def cost_difference(
    platform: str, reference: str, setting: str, first: Struck, second: Struck
) -> dict[str, Any]:
    """The additional cost of the same faults compared with the reference platform.

    Returns:
        `extra_s`: the mean difference of costs; `differ`: how many of them are not zero; `p_value`:
        of the mean, by missions; `p95_ratio`: of the 95th percentiles over own golden; all are
        over the faults that both platforms have a cost of. Of all flights of
        each platform: `largest_ratio` of the largest over own golden, `longest_ratio` of the
        longest in seconds.
    """
    there, here = paired(first.costs, second.costs, MISSION)
    extra = _by_mission(here, "cost_s") - _by_mission(there, "cost_s")
    extra[np.abs(extra) < _SAME_S] = 0.0
    first_own, second_own = _by_mission(there, "over_own"), _by_mission(here, "over_own")
    count = len(extra)
    return {
        "platform": platform,
        "reference": reference,
        "setting": setting,
        "pairs": here.num_rows,
        "differ": int(np.count_nonzero(np.nan_to_num(extra))),
        "extra_s": _over(count, lambda drawn: _mean(extra[drawn])),
        "p_value": sign_flips(np.nansum(extra, axis=1).tolist()) if count else math.nan,
        "p95_ratio": _over(count, lambda drawn: _late(second_own[drawn]) / _late(first_own[drawn])),
        "largest_ratio": second.largest("over_own") / first.largest("over_own"),
        "longest_ratio": second.longest_s / first.longest_s,
    }


def worst_row(
    platform: str,
    setting: str,
    golden: pa.Table,
    faulty: pa.Table,
    flights: pa.Table,
    *,
    protected: bool,
) -> dict[str, Any]:
    """The longest successful flight of a setting, and its ratio to the mean golden one.

    Args:
        golden, faulty: flights of the platform without a detector.
        flights: flights of the setting. The recovery is NaN if the longest flight with faults
            is no longer than the longest golden one.
    """
    golden_s, faulty_s, times_s = (
        numbers(each, "flight_time_s").tolist() for each in (golden, faulty, flights)
    )
    found = worst_case(golden_s, times_s)
    case = worst_case(golden_s, faulty_s, times_s if protected else ())
    return {
        "platform": platform,
        "setting": setting,
        "flights": len(times_s),
        "golden_mean_s": found.golden,
        "worst_s": found.faulty_worst,
        "over_mean_ratio": 1.0 + found.increase,
        "over_mean_recovered_share": case.recovered_share,
    }


# Missions as the resampled unit ---------------------------------------------------------------


def _by_mission(costs: pa.Table, measure: str) -> FloatArray:
    """Values, (missions, targets), in the order of seeds; NaN if there is no flight."""
    seeds, row = np.unique(np.asarray(costs["seed"].to_pylist()), return_inverse=True)
    targets, column = np.unique(np.asarray(costs["target"].to_pylist()), return_inverse=True)
    table = np.full((len(seeds), len(targets)), np.nan)
    table[row, column] = numbers(costs, measure)
    return table


def _over(count: int, statistic: Any) -> dict[str, Any]:
    """A statistic over missions with its interval; `statistic` takes (..., missions) indices."""
    return asdict(interval_of_rows(count, statistic, resamples=RESAMPLES))


def _mean(values: FloatArray) -> FloatArray:
    """Mean over the last two axes, without NaN."""
    return np.asarray(np.nanmean(values, axis=(-2, -1)))


def _late(values: FloatArray) -> FloatArray:
    """The LATE quantile over the last two axes, without NaN.

    `numpy.nanquantile` with several axes goes row by row; sorting puts NaN at the end.
    """
    flat = np.sort(values.reshape((*values.shape[:-2], -1)), axis=-1)
    place = LATE * (np.count_nonzero(~np.isnan(flat), axis=-1) - 1)
    low = np.floor(place).astype(np.intp)
    high = np.ceil(place).astype(np.intp)
    below = np.take_along_axis(flat, low[..., None], axis=-1)[..., 0]
    above = np.take_along_axis(flat, high[..., None], axis=-1)[..., 0]
    return np.asarray(below + (above - below) * (place - low))
