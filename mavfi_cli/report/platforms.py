"""A comparison of platforms as text, and as CSV with one row per number."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import attrgetter
from typing import TypeVar

from mavfi_cli.analysis.platforms import (
    GOLDEN,
    NONE,
    QUANTITIES,
    ChangedQuantity,
    ComparedPlan,
    CostDifference,
    CostRow,
    LongestFlight,
    MeasuredQuantity,
    PlatformComparison,
    PlatformSummary,
    RatioRow,
    SettingFlights,
    WorstFault,
)
from mavfi_cli.report.table import Table, number, p_value, percent, rate, spread
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.stats.bootstrap import FEW
from mavfi_cli.stats.shares import Interval, Share

# The paper, section VII-E: on the TX2, a single bit flip in an inter-kernel state.
PAPER = "paper, Fig. 16: worst case x 2.8 on the TX2, of which GAD recovers 79.3 %, AAD 88.0 %"


def _setting_title(setting: str) -> str:
    return {GOLDEN: "golden", NONE: "faults"}.get(setting, f"faults, {setting}")


def _titles_of(plan: ComparedPlan) -> dict[str, str]:
    return {row.platform: row.title for row in plan.platforms}


def platform_lines(comparison: PlatformComparison) -> list[str]:
    """Return the lines that report a comparison of platforms, as text and tables."""
    plan, settings = comparison.plan, comparison.settings
    lines = _head(plan)
    lines += ["", "Flights that count: golden, or with a fault that was read or caught; medians"]
    lines += _side_by_side(plan, settings, _FLIGHTS, by_setting=True)
    lines += ["", *_side_by_side(plan, settings, _WORK, by_setting=True)]
    for platform in plan.platforms[1:]:
        lines += _against(plan, platform, comparison.ratios, _RATIO_TITLE, _RATIOS)
    if comparison.costs:
        lines += [
            "",
            "What faults cost (Fig. 16), over the mission's golden flight; both successful",
            *_side_by_side(plan, comparison.costs, _COSTS),
        ]
        for platform in plan.platforms[1:]:
            lines += _against(plan, platform, comparison.cost_differences, _EXTRA_TITLE, _EXTRA)
    lines += ["", "The longest successful flights"]
    lines += _side_by_side(plan, comparison.worst, _WORST)
    lines += [*_again(comparison), ""]
    if comparison.errors:
        lines.append(f"{len(comparison.errors)} missions could not be flown.")
    return [
        *lines,
        f"In brackets: {100 * comparison.confidence:g} % intervals, Wilson for success, bootstrap "
        "for the rest.",
        "Energy: the paper's regression; that of the propellers is in compare.json.",
        "Response, depth frame to setpoint: each flight's median and 95th percentile; here the",
        "median over the flights.",
        *_few(settings),
    ]


def _few(settings: Sequence[SettingFlights]) -> list[str]:
    counts = [row.quantities["flight_time_s"].mean.count for row in settings]
    if not any(1 < count < FEW for count in counts):
        return []
    return [f"Bootstrap intervals of fewer than {FEW} flights are too narrow to be believed."]


def _head(plan: ComparedPlan) -> list[str]:
    last = plan.first_seed + plan.missions - 1
    faults = f"{plan.flip}: one a flight; fault seed {plan.seed}" if plan.flip else "none"
    lines = [
        f"Missions    {plan.missions} in {plan.world}, seeds {plan.first_seed} to {last}, "
        "the same on each platform",
        f"Stack       {plan.stack}",
        f"Faults      {faults}",
    ]
    heads = ["Platforms", *[""] * len(plan.platforms)]
    for head, row in zip(heads, plan.platforms, strict=False):
        lines.append(f"{head:<11} {row.title}: {row.description}, {row.cores} cores")
    return lines


# Tables ---------------------------------------------------------------------------------------

OwnRow = TypeVar("OwnRow", bound=SettingFlights | CostRow | LongestFlight)
PairedRow = TypeVar("PairedRow", bound=RatioRow | CostDifference)
Row = TypeVar("Row")
Columns = Mapping[str, Callable[[Row], str]]  # of a table: heading, and the cell of a row


def _side_by_side(
    plan: ComparedPlan,
    rows: Iterable[OwnRow],
    columns: Columns[OwnRow],
    *,
    by_setting: bool = False,
) -> list[str]:
    """Return the lines of a table with one row per platform and setting.

    Args:
        by_setting: whether rows are grouped by setting; otherwise they are grouped by platform.
    """
    titles, last = _titles_of(plan), ""
    lines: list[list[str]] = []
    for row in rows:
        group, other = titles[row.platform], _setting_title(row.setting)
        if by_setting:
            group, other = other, group
        lines.append([group if group != last else "", other, *(c(row) for c in columns.values())])
        last = group
    return Table([["", "", *columns], *lines], labels=2).lines()


def _against(
    plan: ComparedPlan,
    platform: PlatformSummary,
    rows: Iterable[PairedRow],
    title: str,
    columns: Columns[PairedRow],
) -> list[str]:
    """Return a title and a table that compares a platform with the reference, a row per setting."""
    lines = [
        [_setting_title(row.setting), *(cell(row) for cell in columns.values())]
        for row in rows
        if row.platform == platform.platform
    ]
    return [
        "",
        title.format(platform.title, plan.platforms[0].title),
        *Table([["", *columns], *lines], labels=1).lines(),
    ]


_FLIGHTS: Columns[SettingFlights] = {
    "flights": lambda row: f"{row.counted} of {row.flown}",
    "success": lambda row: rate(row.success),
    "flight time, s": lambda row: spread(row.quantities["flight_time_s"].median, 1),
    "distance, m": lambda row: spread(row.quantities["distance_m"].median, 1),
}
_WORK: Columns[SettingFlights] = {
    "energy, kJ": lambda row: spread(row.quantities["energy_regression_j"].median, 1, 1e-3),
    "replans (mean)": lambda row: spread(row.quantities["replans"].mean, 1),
    "response, ms": lambda row: spread(row.quantities["response_median_s"].median, 0, 1e3),
    "95th perc., ms": lambda row: spread(row.quantities["response_p95_s"].median, 0, 1e3),
}
_RATIO_TITLE = "{} over {}, mission by mission (flights that both succeed in; response: all)"
_RATIOS: Columns[RatioRow] = {
    "pairs": lambda row: f"{row.both_succeed}",
    "flight time, x": lambda row: spread(row.quantities["flight_time_s"], 3),
    "energy, x": lambda row: spread(row.quantities["energy_regression_j"], 2),
    "response, x": lambda row: spread(row.quantities["response_median_s"], 2),
    "success, pts": lambda row: number(
        row.success.difference, "+.1f", 100.0, f" ({p_value(row.success.p_value)})"
    ),
}
_COSTS: Columns[CostRow] = {
    "flights": lambda row: f"{row.pairs}",
    "lost": lambda row: f"{row.lost}",
    "mean, s": lambda row: spread(row.cost_s.mean, 2),
    "95th perc., x": lambda row: spread(row.over_own.p95, 3),
    "worst, x": lambda row: number(row.over_own.largest, ".3f"),
    "recovered": lambda row: percent(row.over_own.recovered_share),
}
_EXTRA_TITLE = "{} against {}, fault by fault (faults that both survive; worst, longest: of all)"
_EXTRA: Columns[CostDifference] = {
    "pairs": lambda row: f"{row.pairs}",
    "differ": lambda row: f"{row.differ}",
    "mean, s": lambda row: spread(row.extra_s, 2, chance=row.p_value),
    "95th perc., x": lambda row: spread(row.p95_ratio, 3),
    "worst, x": lambda row: number(row.largest_ratio, ".3f"),
    "longest, x": lambda row: number(row.longest_ratio, ".3f"),
}
_WORST: Columns[LongestFlight] = {
    "longest, s": lambda row: number(row.worst_s, ".1f"),
    "over mean golden, x": lambda row: number(row.over_mean_ratio, ".3f"),
    "recovered": lambda row: percent(row.over_mean_recovered_share),
}


def _again(comparison: PlatformComparison) -> list[str]:
    plan, lines = comparison.plan, []
    titles = _titles_of(plan)
    for row in comparison.costs:
        if row.setting != NONE or row.worst_flight is None:
            continue
        if row.over_own.largest > 1.0:
            lines.append(f"the fault that costs most on {titles[row.platform]}:")
            lines.append(f"  {_command_of(plan, row.platform, row.worst_flight)}")
        else:
            lines.append(f"no fault made a flight longer on {titles[row.platform]}")
    return [*lines, *([PAPER] if plan.inject else [])]


def _command_of(plan: ComparedPlan, platform: str, flight: WorstFault) -> str:
    words = ["mavfi", "fly", "--world", plan.world, "--seed", f"{flight.seed}"]
    words += ["--platform", platform]
    if plan.stack != DEFAULT:
        words += ["--stack", plan.stack]
    if flight.target:
        words += ["--inject", flight.target, "--fault-seed", f"{flight.fault_seed}"]
        words += [] if plan.field is None else ["--field", plan.field]
    return shlex.join(words)


# CSV ------------------------------------------------------------------------------------------

_NAMES = ["table", "platform", "reference", "setting", "quantity", "statistic", "unit", "value",
          "low", "high", "count"]  # fmt: skip
_OVER, _COST = "flight time over own golden", "cost of a fault"
# For each kind of row: quantity, statistic, unit, and the attributes with the number and, if the
# number does not include it, with its sample size.
_NUMBERS: Mapping[str, Sequence[tuple[str, str, str, str, str]]] = {
    "settings": (("success", "share", "1", "success", ""),),
    "ratios": (("success", "difference", "1", "success.difference", "pairs"),),
    "costs": (
        ("lost by faults", "flights", "count", "lost", "compared"),
        (_COST, "mean", "s", "cost_s.mean", ""),
        (_COST, "largest", "s", "cost_s.largest", "pairs"),
        (_OVER, "95th percentile", "1", "over_own.p95", ""),
        (_OVER, "largest", "1", "over_own.largest", "pairs"),
        (_OVER, "share of the largest increase recovered", "1", "over_own.recovered_share",
         "pairs"),
    ),
    "cost_differences": (
        (_COST, "mean difference", "s", "extra_s", ""),
        (_COST, "pairs that differ", "count", "differ", "pairs"),
        (_COST, "p-value of the mean difference", "1", "p_value", "pairs"),
        (_OVER, "ratio of 95th percentiles", "1", "p95_ratio", ""),
        (_OVER, "ratio of the largest", "1", "largest_ratio", ""),
        ("flight time", "ratio of the longest", "1", "longest_ratio", ""),
    ),
    "worst": (
        ("flight time", "largest", "s", "worst_s", "flights"),
        ("flight time", "largest over mean golden", "1", "over_mean_ratio", "flights"),
        ("flight time", "share of the increase over mean golden recovered", "1",
         "over_mean_recovered_share", "flights"),
    ),
}  # fmt: skip


def platform_csv(comparison: PlatformComparison) -> str:
    """Return a comparison of platforms as CSV, with one row per number.

    A row holds platform, setting, quantity, statistic, unit, value, interval and sample size.
    """
    rows = [_NAMES]
    for table, numbers in _NUMBERS.items():
        title = "costs" if table == "cost_differences" else table
        for row in getattr(comparison, table):
            places = [title, row.platform, getattr(row, "reference", ""), row.setting]
            for quantity, statistic, unit, name, count in numbers:
                size = attrgetter(count)(row) if count else None
                cells = _number_cells(attrgetter(name)(row), size)
                rows.append([*places, quantity, statistic, unit, *cells])
            for own in QUANTITIES if table in ("settings", "ratios") else ():
                for statistic, unit, value in _statistics(row.quantities[own.name]):
                    cells = _number_cells(value, None)
                    rows.append([*places, own.title, statistic, unit, *cells])
    return Table(rows).csv()


def _statistics(
    quantity: MeasuredQuantity | ChangedQuantity,
) -> Iterable[tuple[str, str, Interval]]:
    """Return name, unit and value of each statistic of a quantity."""
    if isinstance(quantity, ChangedQuantity):
        return [(quantity.kind, "1" if quantity.kind == "ratio" else quantity.unit, quantity)]
    return [("median", quantity.unit, quantity.median), ("mean", quantity.unit, quantity.mean)]


def _number_cells(value: Interval | Share | float, count: int | None) -> list[str]:
    """Return the cells for a value, the ends of its interval and the sample size.

    A missing number has an empty cell.

    Args:
        count: sample size of a value without an interval; None if unknown.
    """
    if isinstance(value, Share):
        value = value.effect
    if isinstance(value, Interval):
        numbers: tuple[float | None, ...] = (value.value, value.low, value.high, value.count)
    else:
        numbers = (value, None, None, count)
    return ["" if cell is None or math.isnan(cell) else f"{cell}" for cell in numbers]
