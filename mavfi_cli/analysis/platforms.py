"""The numbers of a comparison: settings, ratios between platforms, and costs of faults.

Flight time, distance, energy and replans cover successful flights, response times all counted
flights. A faulty flight is counted if its fault struck a value that was read or caught.

The cost of a fault (Fig. 16 of the paper) is the flight time over that of the golden flight of the
same mission on the same platform, if both reached the goal. It extends the measure of the paper,
which flies one fixed world, to several worlds. The longest flight over the mean golden flight is
also given. It depends on the length of the mission.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import (
    changed,
    chosen,
    flags,
    flown,
    known,
    numbers,
)
from mavfi_cli.analysis.pairs import paired
from mavfi_cli.analysis.summary import RESAMPLES
from mavfi_cli.core.types import FloatArray
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.stats.bootstrap import interval, interval_of_rows, median
from mavfi_cli.stats.paired import OWN, McNemar, sign_flips, worst_case
from mavfi_cli.stats.shares import rate

LATE = 0.95  # quantile given with the worst case, which has no interval
MISSION = ("seed", "target")  # columns that identify a mission on all platforms
_SAME_S = 1e-6  # flight times this close are equal: a tick is 20 ms
GOLDEN, NONE = "golden", "none"  # without fault; with fault and without detector
CONFIDENCE = 0.95  # of all intervals


class _Quantity(NamedTuple):
    """A quantity that is measured in each flight, by the name of its column."""

    name: str
    title: str
    unit: str
    any_end: bool = False  # failed flights have it, too
    ratio: bool = True  # platforms are compared by ratio, else by difference


QUANTITIES = (
    _Quantity("flight_time_s", "flight time", "s"),
    _Quantity("distance_m", "distance", "m"),
    _Quantity("energy_regression_j", "energy (regression)", "J"),
    _Quantity("energy_propeller_j", "energy (propellers)", "J"),
    _Quantity("replans", "replans", "count", ratio=False),
    _Quantity("response_median_s", "response, median", "s", any_end=True),
    _Quantity("response_p95_s", "response, 95th percentile", "s", any_end=True),
)
SCHEMA = pa.schema(
    {
        "platform": pa.string(), "setting": pa.string(), "target": pa.string(), "seed": pa.int64(),
        "fault_seed": pa.int64(), "outcome": pa.string(), "counted": pa.bool_(),
        **{each.name: pa.float64() for each in QUANTITIES},
    }
)  # fmt: skip


def compared(flights: pa.Table) -> pa.Table:
    """The columns of SCHEMA for the missions that ended; golden flights have an empty target."""
    table = flown(flights)
    bare = pc.if_else(pc.is_null(table["level"]), GOLDEN, NONE)
    setting = pc.coalesce(table["detector"].cast(pa.string()), bare)
    target = pc.fill_null(table["fault_target"].cast(pa.string()), "")
    for name, column in (("setting", setting), ("target", target)):
        table = table.append_column(name, column)
    return table.select(SCHEMA.names).cast(SCHEMA)


def figures(platforms: Sequence[str], settings: Sequence[str], flights: pa.Table) -> dict[str, Any]:
    """All numbers of the flights, as plain values.

    `settings`, `costs` and `worst` have one row per platform and setting. `ratios` and
    `cost_differences` have one row per setting and platform other than the first. `flights` has
    one row per flight. Shares, increases and ratios have no unit; all other names end in the unit
    or have it in a key of its own.

    Args:
        flights: with the columns of SCHEMA.
    """
    whole = flights.append_column("succeeded", pc.equal(flights["outcome"], "success"))
    first, *others = platforms
    faulty = [setting for setting in settings if setting != GOLDEN]
    every = {
        (platform, setting): chosen(whole, platform=platform, setting=setting)
        for platform, setting in itertools.product(platforms, (GOLDEN, NONE, *settings))
    }
    counted = {place: chosen(table, counted=True) for place, table in every.items()}
    won = {place: chosen(table, succeeded=True) for place, table in counted.items()}
    found = {
        (platform, setting): FaultCosts.of(won[platform, GOLDEN], counted[platform, setting])
        for platform, setting in itertools.product(platforms, faulty)
    }

    def at(platform: str, setting: str) -> dict[str, Any]:
        return {"platform": platform, "setting": setting}

    return {
        "confidence": CONFIDENCE,
        "settings": [
            {**at(p, s), **_setting(every[p, s], counted[p, s])}
            for s, p in itertools.product(settings, platforms)
        ],
        "ratios": [
            {**at(p, s), "reference": first, **_ratio(counted[first, s], counted[p, s])}
            for p, s in itertools.product(others, settings)
        ],
        "costs": [
            {**at(p, s), **found[p, s].row(found[p, NONE], protected=s != NONE)}
            for p, s in itertools.product(platforms, faulty)
        ],
        "cost_differences": [
            {**at(p, s), "reference": first, **found[p, s].extra(found[first, s])}
            for p, s in itertools.product(others, faulty)
        ],
        "worst": [
            {**at(p, s), **_worst_row(won[p, GOLDEN], won[p, NONE], won[p, s],
                                      protected=s not in (GOLDEN, NONE))}
            for p, s in itertools.product(platforms, settings)
        ],
        "flights": flights.to_pylist(),
    }  # fmt: skip


# One platform and setting ---------------------------------------------------------------------


def _setting(every: pa.Table, counted: pa.Table) -> dict[str, Any]:
    ends = pc.value_counts(counted["outcome"]).to_pylist()
    return {
        "flown": every.num_rows,
        "counted": counted.num_rows,
        "outcomes": dict(sorted((each["values"], each["counts"]) for each in ends)),
        "success": asdict(rate(int(flags(counted, "succeeded").sum()), counted.num_rows)),
        "quantities": {each.name: _measured(each, counted) for each in QUANTITIES},
    }


def _measured(quantity: _Quantity, counted: pa.Table) -> dict[str, Any]:
    chosen_ones = counted if quantity.any_end else chosen(counted, succeeded=True)
    values = known(numbers(chosen_ones, quantity.name))
    return {
        "unit": quantity.unit,
        "median": asdict(interval(values, median, resamples=RESAMPLES)),
        "mean": asdict(interval(values, resamples=RESAMPLES)),
        "largest": max(values.tolist(), default=math.nan),
    }


# Two platforms --------------------------------------------------------------------------------


def _ratio(first: pa.Table, second: pa.Table) -> dict[str, Any]:
    pairs = paired(second, first, MISSION)[::-1]
    test = McNemar.of(*(flags(each, "succeeded") for each in pairs))
    return {
        "pairs": test.pairs,
        "both_succeed": test.both,
        "success": {**asdict(test), "difference": test.difference},
        "quantities": {each.name: _changed(each, *pairs) for each in QUANTITIES},
    }


def _changed(quantity: _Quantity, first: pa.Table, second: pa.Table) -> dict[str, Any]:
    """Geometric mean ratio with its interval, or mean difference for values that may be zero."""
    if not quantity.any_end:
        both = pa.array(flags(first, "succeeded") & flags(second, "succeeded"))
        first, second = first.filter(both), second.filter(both)
    before, after = (numbers(each, quantity.name).tolist() for each in (first, second))
    found = changed(
        first["seed"].to_pylist(), before, after, ratio=quantity.ratio, resamples=RESAMPLES
    )
    kind, unit = ("ratio", "ratio") if quantity.ratio else ("difference", quantity.unit)
    return {"kind": kind, "unit": unit, **asdict(found)}


# Costs of faults -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultCosts:
    """The cost of the faults of a platform and setting, over their own golden flights.

    Attributes:
        costs: one row per pair that reached the goal: `seed`, `target`, `fault_seed`, `cost_s`,
            `over_own`.
        lost: flights that failed where the golden one reached the goal.
        longest_s: longest flight that reached the goal, whether or not the golden one did.
    """

    costs: pa.Table
    lost: int
    longest_s: float

    @classmethod
    def of(cls, golden: pa.Table, counted: pa.Table) -> FaultCosts:
        """Compare flights with the golden flights of the same missions."""
        known, own = paired(counted, golden, ["seed"])
        won = known["succeeded"]
        own_s = numbers(own.filter(won), "flight_time_s")
        pairs = known.filter(won)
        time_s = numbers(pairs, "flight_time_s")
        costs = pairs.select([*MISSION, "fault_seed"]).append_column(
            "cost_s", pa.array(time_s - own_s)
        )
        longest = numbers(chosen(counted, succeeded=True), "flight_time_s")
        return cls(
            costs=costs.append_column("over_own", pa.array(time_s / own_s)),
            lost=known.num_rows - pairs.num_rows,
            longest_s=max(longest.tolist(), default=math.nan),
        )

    def _largest(self, measure: str) -> float:
        found = pc.max(self.costs[measure]).as_py()
        return math.nan if found is None else float(found)

    def row(self, bare: FaultCosts, *, protected: bool) -> dict[str, Any]:
        """The cost of a setting's faults on a platform.

        Args:
            bare: the same without a detector on this platform, the reference of recovery.

        Returns:
            `cost_s`: mean with its interval and the largest; `over_own`: the 95th percentile with
            its interval and the largest. Several faults of one mission are no independent samples:
            intervals draw missions. `recovered_share` is the part of the largest increase without
            detector that is gone, not a number where there is none. `worst_flight`: the one with
            the largest ratio to its golden flight; the lowest seed of equal ones.
        """
        cost_s, over_own = (_by_mission(self.costs, name) for name in ("cost_s", "over_own"))
        worst, count = self._largest("over_own"), len(cost_s)
        recovered = worst_case(OWN, [bare._largest("over_own")], [worst])["recovered_share"]
        rows = self.costs.sort_by([("over_own", "descending"), ("seed", "ascending")])
        flight = rows.select([*MISSION, "fault_seed"]).slice(0, 1).to_pylist()
        return {
            "pairs": self.costs.num_rows,
            "lost": self.lost,
            "cost_s": {
                "mean": _over(count, lambda drawn: _mean(cost_s[drawn])),
                "largest": self._largest("cost_s"),
            },
            "over_own": {
                "p95": _over(count, lambda drawn: _late(over_own[drawn])),
                "largest": worst,
                "recovered_share": recovered if protected else math.nan,
            },
            "worst_flight": flight[0] if flight else None,
        }

    def extra(self, first: FaultCosts) -> dict[str, Any]:
        """The additional cost of the same faults compared with the reference platform.

        Returns:
            `extra_s`: the mean difference of costs; `differ`: how many of them are not zero;
            `p_value`: of the mean, by missions; `p95_ratio`: of the 95th percentiles over own
            golden; all are over the faults that both platforms have a cost of. Of all flights of
            each platform: `largest_ratio` of the largest over own golden, `longest_ratio` of the
            longest in seconds.
        """
        here, there = paired(self.costs, first.costs, MISSION)
        extra = _by_mission(here, "cost_s") - _by_mission(there, "cost_s")
        extra[np.abs(extra) < _SAME_S] = 0.0
        before, after = _by_mission(there, "over_own"), _by_mission(here, "over_own")
        count = len(extra)
        return {
            "pairs": here.num_rows,
            "differ": int(np.count_nonzero(np.nan_to_num(extra))),
            "extra_s": _over(count, lambda drawn: _mean(extra[drawn])),
            "p_value": sign_flips(np.nansum(extra, axis=1).tolist()) if count else math.nan,
            "p95_ratio": _over(count, lambda drawn: _late(after[drawn]) / _late(before[drawn])),
            "largest_ratio": self._largest("over_own") / first._largest("over_own"),
            "longest_ratio": self.longest_s / first.longest_s,
        }


def _worst_row(
    golden: pa.Table, faulty: pa.Table, flights: pa.Table, *, protected: bool
) -> dict[str, Any]:
    """The longest successful flight of a setting, and its ratio to the mean golden one.

    Args:
        flights: flights of the setting. The recovery is NaN if the longest flight with faults
            is no longer than the longest golden one.
    """
    golden_s, faulty_s, times_s = (
        numbers(each, "flight_time_s").tolist() for each in (golden, faulty, flights)
    )
    found = worst_case(golden_s, times_s)
    case = worst_case(golden_s, faulty_s, times_s if protected else ())
    return {
        "flights": len(times_s),
        "golden_mean_s": found["golden"],
        "worst_s": found["faulty_worst"],
        "over_mean_ratio": 1.0 + found["increase"],
        "over_mean_recovered_share": case["recovered_share"],
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


# Descriptions of the platforms ----------------------------------------------------------------


def platforms_told(platforms: Sequence[str]) -> list[dict[str, Any]]:
    """One row of plain values per platform."""
    names, profiles = titles(platforms), {name: load_platform(name) for name in platforms}
    return [
        {
            "platform": name,
            "title": names[name],
            "description": profile.description or profile.name,
            "cores": profile.cores,
            "power_w": profile.power_w,
            "kernel_latency_s": {k: each.latency_s for k, each in profile.kernels.items()},
        }
        for name, profile in profiles.items()
    ]


def titles(platforms: Sequence[str]) -> dict[str, str]:
    """Names of platforms in tables and pictures: the stem of a file, if that is unique."""
    short = [name.removesuffix(".toml").rpartition("/")[2] for name in platforms]
    return {
        name: stem if short.count(stem) == 1 else name
        for name, stem in zip(platforms, short, strict=True)
    }
