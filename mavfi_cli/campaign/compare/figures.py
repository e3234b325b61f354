"""The numbers of a comparison: settings, ratios between platforms, worst cases and recovery.

Flight time, distance, energy and replans are of successful flights; response times of all counted
ones. A faulty flight is counted where its fault struck something that was read or caught.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mavfi_cli.campaign.compare.flights import Flown
from mavfi_cli.campaign.compare.plan import GOLDEN, NONE, ComparePlan
from mavfi_cli.campaign.statistics.bootstrap import Interval, interval, mean, median
from mavfi_cli.campaign.statistics.paired import mcnemar
from mavfi_cli.campaign.statistics.proportions import rate
from mavfi_cli.campaign.statistics.worst_case import worst_case

CONFIDENCE = 0.95
RESAMPLES = 1999


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
    the first, `worst` a row a platform and setting, `flights` a row a flight. Shares, increases and
    ratios have no unit; everything else ends in its unit, or has it beside.
    """
    table = _Table(flights)
    worst = {name: _worst_rows(plan, table, name) for name in plan.platforms}
    first, *others = plan.platforms
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
        "worst": [row for rows in worst.values() for row in rows],
        "worst_ratios": [
            _worst_ratio(*rows)
            for platform in others
            for rows in zip(plan.settings, worst[first], worst[platform], strict=True)
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


# Worst cases, as in the paper's Fig. 16 -----------------------------------------------------------


def _worst_rows(plan: ComparePlan, table: _Table, platform: str) -> list[dict[str, Any]]:
    """The worst successful flights of each setting, and what detectors recover of the worst case.

    Two measures. Over the golden flight of its own mission: the paper flies one fixed world, so
    this is its measure where worlds differ. Over the mean golden flight: the longest flight of
    all, whatever mission it is of; faults that are no worse than the worst golden flight leave
    nothing to recover there.
    """
    golden, faulty = table.won(platform, GOLDEN), table.won(platform, NONE)
    own = {each.seed: each.flight_time_s for each in golden}
    worst = _over_own(faulty, own)
    beyond = max(_times(faulty), default=math.nan) > max(_times(golden), default=math.nan)
    rows = []
    for setting in plan.settings:
        flights = table.won(platform, setting)
        protected = setting not in (GOLDEN, NONE)
        found = worst_case(_times(golden), _times(flights))
        case = worst_case(_times(golden), _times(faulty), _times(flights) if protected else ())
        mine = _over_own(flights, own)
        rows.append(
            {
                "platform": platform,
                "setting": setting,
                "flights": len(flights),
                "golden_mean_s": found.golden,
                "worst_s": found.faulty_worst,
                "over_own_ratio": mine,
                "over_own_recovered_share": (worst - mine) / (worst - 1.0)
                if protected and worst > 1.0
                else math.nan,
                "over_mean_ratio": 1.0 + found.increase,
                "over_mean_recovered_share": case.recovered_share if beyond else math.nan,
                "worst_flight": _named(flights, own),
            }
        )
    return rows


def _times(flights: Sequence[Flown]) -> list[float]:
    return [each.flight_time_s for each in flights]


def _over_own(flights: Sequence[Flown], own: Mapping[int, float]) -> float:
    """The largest flight time over that of the golden flight of the same mission."""
    return max((e.flight_time_s / own[e.seed] for e in flights if e.seed in own), default=math.nan)


def _named(flights: Sequence[Flown], own: Mapping[int, float]) -> dict[str, Any] | None:
    """The flight that is longest over its own golden one, so that it can be flown again."""
    known = [each for each in flights if each.seed in own]
    if not known:
        return None
    most = max(known, key=lambda each: (each.flight_time_s / own[each.seed], -each.seed))
    return {"seed": most.seed, "target": most.target, "fault_seed": most.fault_seed}


def _worst_ratio(
    setting: str, first: Mapping[str, Any], second: Mapping[str, Any]
) -> dict[str, Any]:
    return {
        "platform": second["platform"],
        "reference": first["platform"],
        "setting": setting,
        "worst_ratio": second["worst_s"] / first["worst_s"],
    }
