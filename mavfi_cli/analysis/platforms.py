"""The numbers of a comparison: settings, ratios between platforms, and costs of faults.

Flight time, distance, energy and replans cover successful flights, response times all counted
flights. A faulty flight is counted if its fault struck a value that was read or caught.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.costs import MISSION, cost_difference, cost_row, struck, worst_row
from mavfi_cli.analysis.flights import chosen, flags, flown, known, numbers
from mavfi_cli.analysis.groups import RESAMPLES
from mavfi_cli.analysis.pairs import both_succeed, difference, paired, ratio, success_test
from mavfi_cli.core.types import FloatArray
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.stats.bootstrap import interval, mean, median
from mavfi_cli.stats.shares import rate

GOLDEN, NONE = "golden", "none"  # without fault; with fault and without detector
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """A quantity that is measured in each flight.

    Attributes:
        name: name of its column.
        any_end: whether failed flights have it, too.
        ratio: whether platforms are compared by ratio or by difference.
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
        (platform, setting): struck(won[platform, GOLDEN], counted[platform, setting])
        for platform, setting in itertools.product(platforms, faulty)
    }
    return {
        "confidence": CONFIDENCE,
        "settings": [
            _setting(platform, setting, every[platform, setting], counted[platform, setting])
            for setting, platform in itertools.product(settings, platforms)
        ],
        "ratios": [
            _ratio(platform, first, setting, counted[first, setting], counted[platform, setting])
            for platform, setting in itertools.product(others, settings)
        ],
        "costs": [
            cost_row(*place, found[place], found[place[0], NONE], protected=place[1] != NONE)
            for place in itertools.product(platforms, faulty)
        ],
        "cost_differences": [
            cost_difference(
                platform, first, setting, found[first, setting], found[platform, setting]
            )
            for platform, setting in itertools.product(others, faulty)
        ],
        "worst": [
            worst_row(
                *place, won[place[0], GOLDEN], won[place[0], NONE], won[place],
                protected=place[1] not in (GOLDEN, NONE),
            )
            for place in itertools.product(platforms, settings)
        ],
        "flights": flights.to_pylist(),
    }  # fmt: skip


# One platform and setting ---------------------------------------------------------------------


def _setting(platform: str, setting: str, every: pa.Table, counted: pa.Table) -> dict[str, Any]:
    ends = pc.value_counts(counted["outcome"]).to_pylist()
    return {
        "platform": platform,
        "setting": setting,
        "flown": every.num_rows,
        "counted": counted.num_rows,
        "outcomes": dict(sorted((each["values"], each["counts"]) for each in ends)),
        "success": asdict(
            rate(int(flags(counted, "succeeded").sum()), counted.num_rows, CONFIDENCE)
        ),
        "quantities": {each.name: _measured(each, counted) for each in QUANTITIES},
    }


def _measured(quantity: Quantity, counted: pa.Table) -> dict[str, Any]:
    chosen_ones = counted if quantity.any_end else chosen(counted, succeeded=True)
    values = known(numbers(chosen_ones, quantity.name))
    return {
        "unit": quantity.unit,
        "median": _spread(values, median),
        "mean": _spread(values, mean),
        "largest": max(values.tolist(), default=math.nan),
    }


def _spread(values: FloatArray, statistic: Callable[[FloatArray], FloatArray]) -> dict[str, Any]:
    return asdict(interval(values, statistic, confidence=CONFIDENCE, resamples=RESAMPLES))


# Two platforms --------------------------------------------------------------------------------


def _ratio(
    platform: str, reference: str, setting: str, first: pa.Table, second: pa.Table
) -> dict[str, Any]:
    """Ratio of the second platform to the first, mission by mission."""
    pairs = paired(first, second, MISSION)
    test = success_test(*pairs)
    return {
        "platform": platform,
        "reference": reference,
        "setting": setting,
        "pairs": test.pairs,
        "both_succeed": test.both,
        "success": {**asdict(test), "difference": test.difference},
        "quantities": {each.name: _changed(each, *pairs) for each in QUANTITIES},
    }


def _changed(quantity: Quantity, first: pa.Table, second: pa.Table) -> dict[str, Any]:
    """Geometric mean ratio with its interval, or mean difference for values that may be zero."""
    if not quantity.any_end:
        both = pa.array(both_succeed(first, second))
        first, second = first.filter(both), second.filter(both)
    before, after = (numbers(each, quantity.name).tolist() for each in (first, second))
    change = ratio if quantity.ratio else difference
    found = asdict(change(first["seed"].to_pylist(), before, after, resamples=RESAMPLES))
    if quantity.ratio:
        return {"kind": "ratio", "unit": "ratio", **found}
    return {"kind": "difference", "unit": quantity.unit, **found}


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
