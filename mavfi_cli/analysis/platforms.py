"""The numbers of a comparison of platforms: results of settings, ratios, and costs of faults.

Flight time, distance, energy and replans are computed over the counted flights that succeeded.
Response times are computed over all counted flights. A faulty flight counts if its fault struck,
unless the corrupted value expired before anything read it. It also counts if a detector withheld
the value.

The cost of a fault (Fig. 16 of the paper) is the flight time divided by that of the golden flight
of the same mission on the same platform, if both reached the goal. The paper measures this in one
fixed world; here it covers several. The ratio of the longest flight to the mean golden flight is
also given, although it depends on the lengths of the missions.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import IntArray, changed, flags, numbers
from mavfi_cli.analysis.pairs import Flights, paired
from mavfi_cli.analysis.timeline import Timeline
from mavfi_cli.core.types import FloatArray
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.stats.bootstrap import TABLE_RESAMPLES, interval, interval_of_rows, median
from mavfi_cli.stats.paired import McNemar, WorstCase, sign_flips
from mavfi_cli.stats.shares import Interval, Share

LATE = 0.95  # quantile given with the worst case, because the worst case has no interval
MISSION = ("seed", "target")  # columns that identify a mission on all platforms
_SAME_S = 1e-6  # flight times this close are equal: a tick is 20 ms
GOLDEN, NONE = "golden", "none"  # without fault; with fault and without detector
CONFIDENCE = 0.95  # confidence level of all intervals


class _Quantity(NamedTuple):
    """A quantity that is measured in each flight; `name` is its column in the table of flights."""

    name: str
    title: str
    unit: str
    any_end: bool = False  # whether failed flights have the quantity too
    ratio: bool = True  # True compares platforms by ratio, False by difference


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
        **{quantity.name: pa.float64() for quantity in QUANTITIES},
    }
)  # fmt: skip


def compared(flights: pa.Table) -> Flights:
    """Return the flown missions with the additional columns `setting` and `target` of SCHEMA.

    The setting is the detector, or `golden` or `none` for flights without a detector. The target is
    that of the fault, and empty for flights without a fault.
    """
    table = Flights.of(flights).table
    bare = pc.if_else(pc.is_null(table["level"]), GOLDEN, NONE)
    table = table.append_column("setting", pc.coalesce(table["detector"], bare))
    return Flights(table.append_column("target", pc.fill_null(table["fault_target"], "")))


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatformSummary:
    """A platform of a comparison, with its cores, power and kernel latencies.

    `platform` is its name or the path of its file, `title` its name in tables.
    """

    platform: str
    title: str
    description: str
    cores: int
    power_w: float
    kernel_latency_s: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedPlan:
    """The plan of a comparison of platforms, as stored in `compare.json`.

    Attributes:
        inject: targets of the faults: stages, states or groups.
        missions: number of missions per platform, setting and target.
        seed: seed of the faults.
        field: field of the flipped bits; None for any bit.
    """

    platforms: tuple[PlatformSummary, ...]
    world: str
    inject: tuple[str, ...]
    detectors: tuple[str, ...]
    missions: int
    first_seed: int
    seed: int
    field: str | None
    stack: str
    settings: tuple[str, ...]

    @property
    def flip(self) -> str:
        """A phrase for the bits that are flipped in each faulty flight; empty without faults."""
        bits = "one bit" if self.field is None else f"one bit of the {self.field}"
        return f"{bits} in {', '.join(self.inject)}" if self.inject else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredQuantity:
    """The median, mean and largest value of a quantity over the flights of a setting."""

    unit: str
    median: Interval
    mean: Interval
    largest: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingFlights:
    """The results of the flights of one setting on one platform.

    Attributes:
        flown, counted: number of flights, and of those that count for the other results.
        outcomes: number of counted flights by outcome.
        success: share of counted flights that succeed.
        quantities: the measured quantities, keyed by name.
    """

    platform: str
    setting: str
    flown: int
    counted: int
    outcomes: dict[str, int]
    success: Share
    quantities: dict[str, MeasuredQuantity]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangedQuantity(Interval):
    """The change of a quantity from the reference platform to another, with its interval.

    `kind` tells what the value is: a mean `ratio` or a mean `difference`.
    """

    kind: str
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RatioRow:
    """The comparison of a platform with the reference platform over the same missions.

    Attributes:
        pairs: number of missions that count on both platforms.
        both_succeed: number of these missions that succeed on both platforms.
        success: comparison of the success rates.
        quantities: the change of each quantity, keyed by name.
    """

    platform: str
    setting: str
    reference: str
    pairs: int
    both_succeed: int
    success: McNemar
    quantities: dict[str, ChangedQuantity]


@dataclass(frozen=True, slots=True, kw_only=True)
class _CostInSeconds:
    """Flight time minus golden flight time: mean and largest value, in seconds.

    The confidence interval is bootstrapped over missions, not over faults.
    """

    mean: Interval
    largest: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _CostRatio:
    """Flight time divided by golden flight time: 95th percentile and largest value.

    Attributes:
        recovered_share: share of the largest increase without a detector that the detector removes;
            NaN if there is no increase or no detector.
    """

    p95: Interval
    largest: float
    recovered_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstFault:
    """The mission seed, the target and the fault seed with which a flight can be repeated."""

    seed: int
    target: str
    fault_seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CostRow:
    """How much longer the faults of one setting make the flights on one platform.

    Attributes:
        pairs: number of faulty flights that reached the goal and whose golden flights did so too.
        lost: number of faulty flights that failed although their golden flights reached the goal.
        cost_s: flight time minus golden flight time.
        over_own: flight time divided by golden flight time.
        worst_flight: the flight with the largest ratio; among equals, the one with the lowest seed.
            None if `pairs` is 0.
    """

    platform: str
    setting: str
    pairs: int
    lost: int
    cost_s: _CostInSeconds
    over_own: _CostRatio
    worst_flight: WorstFault | None

    @property
    def compared(self) -> int:
        """Number of faulty flights whose golden flights reached the goal."""
        return self.pairs + self.lost


@dataclass(frozen=True, slots=True, kw_only=True)
class CostDifference:
    """How much more the same faults cost on a platform than on the reference platform.

    The cost of a fault is the flight time minus the golden flight time on the same platform.

    Attributes:
        pairs: number of faults that have a cost on both platforms.
        differ: number of pairs with different costs.
        extra_s: mean difference of the costs, with an interval bootstrapped over missions.
        p_value: p-value of this difference, from a sign-flip test with missions as units.
        p95_ratio: ratio of the 95th percentiles of flight time / own golden flight time.
        largest_ratio: the same for the largest values, over all flights of each platform.
        longest_ratio: ratio of the longest flight times, over all flights of each platform.
    """

    platform: str
    setting: str
    reference: str
    pairs: int
    differ: int
    extra_s: Interval
    p_value: float
    p95_ratio: Interval
    largest_ratio: float
    longest_ratio: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LongestFlight:
    """The longest successful flight of a setting, compared with the mean golden flight.

    Attributes:
        flights: number of successful flights.
        golden_mean_s: mean time of the golden flights.
        worst_s: time of the longest flight of the setting.
        over_mean_ratio: `worst_s` / `golden_mean_s`.
        over_mean_recovered_share: share of the increase over the mean golden flight that the
            detector recovers; NaN if the longest flight with faults is no longer than the longest
            golden one, or if the setting has no detector.
    """

    platform: str
    setting: str
    flights: int
    golden_mean_s: float
    worst_s: float
    over_mean_ratio: float
    over_mean_recovered_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedTimelines:
    """Timelines of one mission: one for each platform whose flight reacted to a depth frame."""

    seed: int
    platforms: list[Timeline]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatformComparison:
    """The contents of `compare.json`: the plan and all results of a comparison of platforms.

    `settings`, `costs` and `worst` have one row per platform and setting. `ratios` and
    `cost_differences` have one row per setting and platform other than the first. Shares, increases
    and ratios have no unit; all other names end in their unit, or a separate field gives it.

    Attributes:
        flights: one row per flight, with the columns of SCHEMA.
        errors: one text for each mission that could not begin.
    """

    confidence: float = CONFIDENCE
    settings: list[SettingFlights]
    ratios: list[RatioRow]
    costs: list[CostRow]
    cost_differences: list[CostDifference]
    worst: list[LongestFlight]
    flights: list[dict[str, Any]]
    schema: int
    plan: ComparedPlan
    versions: dict[str, str]
    errors: list[str]
    timeline: ComparedTimelines


def figures(plan: ComparedPlan, flights: Flights, **about: Any) -> PlatformComparison:
    """Compute all results of a comparison from its flights.

    Args:
        flights: the flights that `compared` returns, with the columns of SCHEMA.
        about: the other fields of `PlatformComparison`.
    """
    platforms, settings = [row.platform for row in plan.platforms], plan.settings
    first, *others = platforms
    faulty = [setting for setting in settings if setting != GOLDEN]
    every = {
        (platform, setting): flights.chosen(platform=platform, setting=setting)
        for platform, setting in itertools.product(platforms, (GOLDEN, NONE, *settings))
    }
    counted = {place: those.chosen(counted=True) for place, those in every.items()}
    won = {place: those.chosen(lost=False) for place, those in counted.items()}
    costs = {place: FaultCosts(those) for place, those in counted.items()}
    return PlatformComparison(
        plan=plan,
        **about,
        settings=[
            _setting(p, s, len(every[p, s]), counted[p, s])
            for s, p in itertools.product(settings, platforms)
        ],
        ratios=[
            _ratio(p, s, first, counted[first, s], counted[p, s])
            for p, s in itertools.product(others, settings)
        ],
        costs=[costs[p, s].row(p, s) for p, s in itertools.product(platforms, faulty)],
        cost_differences=[
            costs[p, s].beyond(costs[first, s], p, s, first)
            for p, s in itertools.product(others, faulty)
        ],
        worst=[
            _longest(p, s, won[p, GOLDEN], won[p, NONE], won[p, s])
            for p, s in itertools.product(platforms, settings)
        ],
        flights=flights.table.select(SCHEMA.names).cast(SCHEMA).to_pylist(),
    )


def _setting(platform: str, setting: str, flown: int, counted: Flights) -> SettingFlights:
    return SettingFlights(
        platform=platform,
        setting=setting,
        flown=flown,
        counted=len(counted),
        outcomes=dict(sorted(Counter(counted["outcome"]).items())),
        success=counted.share(value=False),
        quantities={own.name: _measured(own, counted) for own in QUANTITIES},
    )


def _measured(quantity: _Quantity, counted: Flights) -> MeasuredQuantity:
    values = (counted if quantity.any_end else counted.chosen(lost=False)).known(quantity.name)
    return MeasuredQuantity(
        unit=quantity.unit,
        median=interval(values, median, resamples=TABLE_RESAMPLES),
        mean=interval(values, resamples=TABLE_RESAMPLES),
        largest=max(values.tolist(), default=math.nan),
    )


def _ratio(
    platform: str, setting: str, reference: str, first: Flights, second: Flights
) -> RatioRow:
    pairs = paired(second.table, first.table, MISSION)[::-1]
    test = McNemar.of(*(~flags(table, "lost") for table in pairs))
    return RatioRow(
        platform=platform,
        setting=setting,
        reference=reference,
        pairs=test.pairs,
        both_succeed=test.both,
        success=test,
        quantities={quantity.name: _changed(quantity, *pairs) for quantity in QUANTITIES},
    )


def _changed(quantity: _Quantity, first: pa.Table, second: pa.Table) -> ChangedQuantity:
    """Return the change of a quantity from the first flight of each pair to the second.

    It is the geometric mean of the ratios, or the mean difference for quantities that may be zero.
    """
    if not quantity.any_end:
        both = pa.array(~(flags(first, "lost") | flags(second, "lost")))
        first, second = first.filter(both), second.filter(both)
    before, after = (numbers(table, quantity.name).tolist() for table in (first, second))
    change = changed(
        first["seed"].to_pylist(), before, after, ratio=quantity.ratio, resamples=TABLE_RESAMPLES
    )
    kind, unit = ("ratio", "ratio") if quantity.ratio else ("difference", quantity.unit)
    return ChangedQuantity(kind=kind, unit=unit, **asdict(change))


# Costs of faults -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FaultCosts:
    """The costs of the faults in the counted flights of one platform and one setting.

    Each flight is compared with its own golden flight.
    """

    counted: Flights

    @property
    def costs(self) -> pa.Table:
        """The faulty flights that reached the goal and whose golden flights did so too."""
        return self.counted.timed.table

    @property
    def longest_s(self) -> float:
        """The longest time, in seconds, of a flight that reached the goal.

        The golden flight need not have reached it. NaN if no flight did.
        """
        times_s = self.counted.chosen(lost=False).numbers("flight_time_s")
        return max(times_s.tolist(), default=math.nan)

    def _largest(self, measure: str) -> float:
        return max(numbers(self.costs, measure).tolist(), default=math.nan)

    def row(self, platform: str, setting: str) -> CostRow:
        """Summarise the costs of these faults in one row of the comparison.

        Several faults of one mission are not independent, so the intervals are bootstrapped over
        missions.

        Args:
            platform, setting: names to put into the row.
        """
        cost_s, over_own = (_by_mission(self.costs, name) for name in ("added_s", "over_own"))
        count = len(cost_s)
        rows = self.costs.sort_by([("over_own", "descending"), ("seed", "ascending")])
        flights = rows.select([*MISSION, "fault_seed"]).slice(0, 1).to_pylist()
        return CostRow(
            platform=platform,
            setting=setting,
            pairs=self.costs.num_rows,
            lost=len(self.counted.chosen(own_lost=False, lost=True)),
            cost_s=_CostInSeconds(
                mean=_over(count, lambda drawn: _mean(cost_s[drawn])),
                largest=self._largest("added_s"),
            ),
            over_own=_CostRatio(
                p95=_over(count, lambda drawn: _late(over_own[drawn])),
                largest=self._largest("over_own"),
                recovered_share=(
                    math.nan if setting == NONE else self.counted.worst.recovered_share
                ),
            ),
            worst_flight=WorstFault(**flights[0]) if flights else None,
        )

    def beyond(
        self, first: FaultCosts, platform: str, setting: str, reference: str
    ) -> CostDifference:
        """Compute how much more the same faults cost here than on the reference platform.

        Args:
            first: costs of the same setting on the reference platform.
            platform, setting, reference: names to put into the result.
        """
        here, there = paired(self.costs, first.costs, MISSION)
        extra = _by_mission(here, "added_s") - _by_mission(there, "added_s")
        extra[np.abs(extra) < _SAME_S] = 0.0
        before, after = _by_mission(there, "over_own"), _by_mission(here, "over_own")
        count = len(extra)
        return CostDifference(
            platform=platform,
            setting=setting,
            reference=reference,
            pairs=here.num_rows,
            differ=int(np.count_nonzero(np.nan_to_num(extra))),
            extra_s=_over(count, lambda drawn: _mean(extra[drawn])),
            p_value=sign_flips(np.nansum(extra, axis=1).tolist()) if count else math.nan,
            p95_ratio=_over(count, lambda drawn: _late(after[drawn]) / _late(before[drawn])),
            largest_ratio=self._largest("over_own") / first._largest("over_own"),
            longest_ratio=self.longest_s / first.longest_s,
        )


def _longest(
    platform: str, setting: str, golden: Flights, faulty: Flights, flights: Flights
) -> LongestFlight:
    golden_s, faulty_s, times_s = (
        those.numbers("flight_time_s").tolist() for those in (golden, faulty, flights)
    )
    own = WorstCase.of(golden_s, times_s)
    protected_s = () if setting in (GOLDEN, NONE) else times_s
    return LongestFlight(
        platform=platform,
        setting=setting,
        flights=len(times_s),
        golden_mean_s=own.golden,
        worst_s=own.faulty_worst,
        over_mean_ratio=1.0 + own.increase,
        over_mean_recovered_share=WorstCase.of(golden_s, faulty_s, protected_s).recovered_share,
    )


# Missions as the resampled unit ---------------------------------------------------------------


def _by_mission(costs: pa.Table, measure: str) -> FloatArray:
    """Return the values of a column as an array of shape (missions, targets).

    Rows are in the order of the seeds. A value is NaN if the mission has no flight with the target.
    """
    seeds, row = np.unique(np.asarray(costs["seed"].to_pylist()), return_inverse=True)
    targets, column = np.unique(np.asarray(costs["target"].to_pylist()), return_inverse=True)
    table = np.full((len(seeds), len(targets)), np.nan)
    table[row, column] = numbers(costs, measure)
    return table


def _over(count: int, statistic: Callable[[IntArray], FloatArray]) -> Interval:
    """Return the value of `statistic` with a confidence interval bootstrapped over missions.

    Args:
        count: number of missions.
        statistic: takes mission indices of shape (..., missions) and returns an array of shape
            (...).
    """
    return interval_of_rows(count, statistic, resamples=TABLE_RESAMPLES)


def _mean(values: FloatArray) -> FloatArray:
    """Return the mean over the last two axes, ignoring NaN."""
    return np.asarray(np.nanmean(values, axis=(-2, -1)))


def _late(values: FloatArray) -> FloatArray:
    """Return the LATE quantile of the values over the last two axes, ignoring NaN.

    The values are sorted, which puts NaN last. `numpy.nanquantile` would be slower, because it
    loops over rows.
    """
    flat = np.sort(values.reshape((*values.shape[:-2], -1)), axis=-1)
    place = LATE * (np.count_nonzero(~np.isnan(flat), axis=-1) - 1)
    low = np.floor(place).astype(np.intp)
    high = np.ceil(place).astype(np.intp)
    below = np.take_along_axis(flat, low[..., None], axis=-1)[..., 0]
    above = np.take_along_axis(flat, high[..., None], axis=-1)[..., 0]
    return np.asarray(below + (above - below) * (place - low))


# Descriptions of the platforms ----------------------------------------------------------------


def summaries(platforms: Sequence[str]) -> tuple[PlatformSummary, ...]:
    """Load platforms, which are given by name or file, and return a summary of each."""
    names, profiles = titles(platforms), {name: load_platform(name) for name in platforms}
    return tuple(
        PlatformSummary(
            platform=name,
            title=names[name],
            description=profile.description or profile.name,
            cores=profile.cores,
            power_w=profile.power_w,
            kernel_latency_s={key: own.latency_s for key, own in profile.kernels.items()},
        )
        for name, profile in profiles.items()
    )


def titles(platforms: Sequence[str]) -> dict[str, str]:
    """Return the name of each platform for tables and pictures, keyed by its name or file.

    A file is named by its stem, unless another platform has the same name.
    """
    short = [name.removesuffix(".toml").rpartition("/")[2] for name in platforms]
    return {
        name: stem if short.count(stem) == 1 else name
        for name, stem in zip(platforms, short, strict=True)
    }
