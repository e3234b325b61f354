"""The numbers of a comparison: settings, ratios between platforms, and what faults cost.

Flight time, distance, energy and replans are of successful flights; response times of all counted
ones. A faulty flight is counted where its fault struck something that was read or caught.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mavfi_cli.campaign.compare.costs import (
    CONFIDENCE,
    RESAMPLES,
    cost_difference,
    cost_row,
    struck,
    worst_row,
)
from mavfi_cli.campaign.compare.flights import Flown
from mavfi_cli.campaign.compare.plan import GOLDEN, NONE, ComparePlan
from mavfi_cli.stats.bootstrap import Interval, interval, mean, median
from mavfi_cli.stats.paired import mcnemar
from mavfi_cli.stats.shares import rate


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """Something that is measured of each flight.

    Attributes:
        name: a field of `Flown`.
        any_end: measured of failed flights too.
        ratio: whether platforms are compared by ratio; else by difference.
    """

    name: str
    title: str
    unit: str
    any_end: bool = False
    ratio: bool = True


QUANTITIES = (
    Quantity(name="flight_time_s", title="flight time", unit="s"),
    Quantity(name="distance_m", title="distance", unit="m"),
    Quantity(name="energy_regression_j", title="energy (regression)", unit="J"),
    Quantity(name="energy_propeller_j", title="energy (propellers)", unit="J"),
    Quantity(name="replans", title="replans", unit="count", ratio=False),
    Quantity(name="response_median_s", title="response, median", unit="s", any_end=True),
    Quantity(name="response_p95_s", title="response, 95th percentile", unit="s", any_end=True),
)


def figures(plan: ComparePlan, flights: Sequence[Flown]) -> dict[str, Any]:
    """All numbers of the flights, as plain values.

    `settings` has a row a platform and setting, `ratios` a row a setting and platform other than
    the first, `costs` and `worst` a row a platform and setting, `cost_differences` a row a setting
    and platform other than the first, `flights` a row a flight. Shares, increases and ratios have
    no unit; everything else ends in its unit, or has it beside.
    """
    table = _Table(flights)
    first, *others = plan.platforms
    faulty = [setting for setting in plan.settings if setting != GOLDEN]
    found = {
        (platform, setting): struck(table.won(platform, GOLDEN), table.counted(platform, setting))
        for platform in plan.platforms
        for setting in faulty
    }
    return {
        "confidence": CONFIDENCE,
        "settings": [
            _setting(table, platform, setting)
            for setting in plan.settings
            for platform in plan.platforms
        ],
        "ratios": [
            _ratio(table, setting, first, platform)
            for platform in others
            for setting in plan.settings
        ],
        "costs": [
            cost_row(platform, setting, found[platform, setting], found[platform, NONE])
            for platform in plan.platforms
            for setting in faulty
        ],
        "cost_differences": [
            cost_difference(
                platform, first, setting, found[first, setting], found[platform, setting]
            )
            for platform in others
            for setting in faulty
        ],
        "worst": [
            worst_row(platform, setting, *(table.won(platform, s) for s in (GOLDEN, NONE, setting)))
            for platform in plan.platforms
            for setting in plan.settings
        ],
        "flights": [asdict(each) for each in flights],
    }


class _Table:
    """Flights by platform and setting."""

    def __init__(self, flights: Sequence[Flown]) -> None:
        self._flights: dict[tuple[str, str], list[Flown]] = {}
        for each in flights:
            self._flights.setdefault((each.platform, each.setting), []).append(each)

    def all(self, platform: str, setting: str) -> list[Flown]:
        """Every flight."""
        return self._flights.get((platform, setting), [])

    def counted(self, platform: str, setting: str) -> list[Flown]:
        """Those in whose end the fault, if there was one, had a part."""
        return [each for each in self.all(platform, setting) if each.counted]

    def won(self, platform: str, setting: str) -> list[Flown]:
        """The counted ones that reached their goal."""
        return [each for each in self.counted(platform, setting) if each.succeeded]


# One platform and setting -------------------------------------------------------------------------


def _setting(table: _Table, platform: str, setting: str) -> dict[str, Any]:
    flown, counted = table.all(platform, setting), table.counted(platform, setting)
    return {
        "platform": platform,
        "setting": setting,
        "flown": len(flown),
        "counted": len(counted),
        "outcomes": dict(sorted(Counter(each.outcome for each in counted).items())),
        "success": asdict(rate(sum(e.succeeded for e in counted), len(counted), CONFIDENCE)),
        "quantities": {each.name: _measured(each, counted) for each in QUANTITIES},
    }


def _measured(quantity: Quantity, counted: Sequence[Flown]) -> dict[str, Any]:
    values = _values(quantity, counted)
    return {
        "unit": quantity.unit,
        "median": asdict(_interval(values, median)),
        "mean": asdict(_interval(values, mean)),
        "largest": max(values, default=math.nan),
    }


def _values(quantity: Quantity, counted: Sequence[Flown]) -> list[float]:
    found = [getattr(e, quantity.name) for e in counted if e.succeeded or quantity.any_end]
    return [value for value in found if not math.isnan(value)]


def _interval(values: Sequence[float], statistic: Callable[..., Any]) -> Interval:
    return interval(values, statistic, confidence=CONFIDENCE, resamples=RESAMPLES)


# Two platforms ------------------------------------------------------------------------------------


def _ratio(table: _Table, setting: str, first: str, second: str) -> dict[str, Any]:
    """The second platform over the first, mission by mission."""
    reference = {each.mission: each for each in table.counted(first, setting)}
    pairs = [
        (reference[each.mission], each)
        for each in table.counted(second, setting)
        if each.mission in reference
    ]
    test = mcnemar((a.succeeded, b.succeeded) for a, b in pairs)
    return {
        "platform": second,
        "reference": first,
        "setting": setting,
        "pairs": len(pairs),
        "both_succeed": sum(a.succeeded and b.succeeded for a, b in pairs),
        "success": {**asdict(test), "difference": test.difference},
        "quantities": {each.name: _paired(each, pairs) for each in QUANTITIES},
    }


def _paired(quantity: Quantity, pairs: Sequence[tuple[Flown, Flown]]) -> dict[str, Any]:
    """The geometric mean of ratios with its interval; of what may be zero, the mean difference.

    Faults at several targets of one mission are not independent: their mean counts as one value.
    """
    by_seed: dict[int, list[float]] = {}
    for a, b in pairs:
        if quantity.any_end or (a.succeeded and b.succeeded):
            value = _compared(quantity, getattr(a, quantity.name), getattr(b, quantity.name))
            if not math.isnan(value):
                by_seed.setdefault(a.seed, []).append(value)
    found = asdict(_interval([math.fsum(v) / len(v) for v in by_seed.values()], mean))
    if not quantity.ratio:
        return {"kind": "difference", "unit": quantity.unit, **found}
    ends = {name: math.exp(found[name]) for name in ("value", "low", "high")}
    return {"kind": "ratio", "unit": "ratio", **ends, "count": found["count"]}


def _compared(quantity: Quantity, first: float, second: float) -> float:
    """The difference, or the logarithm of the ratio; not a number where there is none."""
    if not quantity.ratio:
        return second - first
    return math.log(second / first) if first > 0.0 and second > 0.0 else math.nan
