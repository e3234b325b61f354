"""A comparison of platforms as text, and as CSV with one row per number."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from mavfi_cli.analysis.platforms import GOLDEN, NONE, QUANTITIES
from mavfi_cli.report.table import Table, number, p_value, percent, rate, spread
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.stats.bootstrap import FEW

Row = Mapping[str, Any]
# The paper, section VII-E: on the TX2, a single bit flip in an inter-kernel state.
PAPER = "paper, Fig. 16: worst case x 2.8 on the TX2, of which GAD recovers 79.3 %, AAD 88.0 %"


def _setting_title(setting: str) -> str:
    return {GOLDEN: "golden", NONE: "faults"}.get(setting, f"faults, {setting}")


def _titles_of(told: Row) -> dict[str, str]:
    return {row["platform"]: row["title"] for row in told["plan"]["platforms"]}


def platform_lines(told: Row) -> list[str]:
    """The comparison in words and columns."""
    others = told["plan"]["platforms"][1:]
    lines = _head(told)
    lines += ["", "Flights that count: golden, or with a fault that was read or caught; medians"]
    lines += _beside(told, "settings", "setting", _FLIGHTS, _flight_cells)
    lines += ["", *_beside(told, "settings", "setting", _WORK, _work_cells)]
    for platform in others:
        lines += ["", *_against(told, "ratios", platform, _RATIOS, _ratio_cells)]
    if told["costs"]:
        lines += [
            "",
            "What faults cost (Fig. 16), over the mission's golden flight; both successful",
            *_beside(told, "costs", "platform", _COSTS, _cost_cells),
        ]
        for platform in others:
            lines += ["", *_against(told, "cost_differences", platform, _EXTRA, _extra_cells)]
    lines += ["", "The longest successful flights"]
    lines += _beside(told, "worst", "platform", _WORST, _worst_cells)
    lines += [*_again(told), ""]
    if told["errors"]:
        lines.append(f"{len(told['errors'])} missions could not be flown.")
    return [
        *lines,
        f"In brackets: {100 * told['confidence']:g} % intervals, Wilson for success, bootstrap for "
        "the rest.",
        "Energy: the paper's regression; that of the propellers is in compare.json.",
        "Response, depth frame to setpoint: each flight's median and 95th percentile; here the",
        "median over the flights.",
        *_few(told),
    ]


def _few(told: Row) -> list[str]:
    counts = [row["quantities"]["flight_time_s"]["mean"]["count"] for row in told["settings"]]
    if not any(1 < count < FEW for count in counts):
        return []
    return [f"Bootstrap intervals of fewer than {FEW} flights are too narrow to be believed."]


def _head(told: Row) -> list[str]:
    plan = told["plan"]
    last = plan["first_seed"] + plan["missions"] - 1
    faults = "none"
    if plan["inject"]:
        bits = "one bit" if plan["field"] is None else f"one bit of the {plan['field']}"
        struck = ", ".join(plan["inject"])
        faults = f"{bits} in {struck}: one a flight; fault seed {plan['seed']}"
    lines = [
        f"Missions    {plan['missions']} in {plan['world']}, seeds {plan['first_seed']} to {last}, "
        "the same on each platform",
        f"Stack       {plan['stack']}",
        f"Faults      {faults}",
    ]
    heads = ["Platforms", *[""] * len(plan["platforms"])]
    for head, row in zip(heads, plan["platforms"], strict=False):
        lines.append(f"{head:<11} {row['title']}: {row['description']}, {row['cores']} cores")
    return lines


# Tables ---------------------------------------------------------------------------------------


def _beside(told: Row, name: str, first: str, head: Sequence[str], cells: Any) -> list[str]:
    titles, last, rows = _titles_of(told), "", []
    for row in told[name]:
        labels = [titles[row["platform"]], _setting_title(row["setting"])]
        labels = labels if first == "platform" else labels[::-1]
        rows.append([labels[0] if labels[0] != last else "", labels[1], *cells(row)])
        last = labels[0]
    return Table([["", "", *head], *rows], labels=2).lines()


def _against(told: Row, name: str, platform: Row, head: Sequence[str], cells: Any) -> list[str]:
    rows = [row for row in told[name] if row["platform"] == platform["platform"]]
    title, *names = head
    told_rows = [[_setting_title(row["setting"]), *cells(row)] for row in rows]
    reference = _titles_of(told)[rows[0]["reference"]]
    return [
        title.format(platform["title"], reference),
        *Table([["", *names], *told_rows], labels=1).lines(),
    ]


_FLIGHTS = ("flights", "success", "flight time, s", "distance, m")
_WORK = ("energy, kJ", "replans (mean)", "response, ms", "95th perc., ms")
_RATIOS = (
    "{} over {}, mission by mission (flights that both succeed in; response: all)",
    "pairs", "flight time, x", "energy, x", "response, x", "success, pts",
)  # fmt: skip
_COSTS = ("flights", "lost", "mean, s", "95th perc., x", "worst, x", "recovered")
_EXTRA = (
    "{} against {}, fault by fault (faults that both survive; worst, longest: of all)",
    "pairs", "differ", "mean, s", "95th perc., x", "worst, x", "longest, x",
)  # fmt: skip
_WORST = ("longest, s", "over mean golden, x", "recovered")


def _flight_cells(row: Row) -> list[str]:
    found = row["quantities"]
    medians = (spread(found[name]["median"], 1) for name in ("flight_time_s", "distance_m"))
    return [f"{row['counted']} of {row['flown']}", rate(row["success"]), *medians]


def _work_cells(row: Row) -> list[str]:
    found = row["quantities"]
    return [
        spread(found["energy_regression_j"]["median"], 1, 1e-3),
        spread(found["replans"]["mean"], 1),
        spread(found["response_median_s"]["median"], 0, 1e3),
        spread(found["response_p95_s"]["median"], 0, 1e3),
    ]


def _ratio_cells(row: Row) -> list[str]:
    found, test = row["quantities"], row["success"]
    points = number(test["difference"], "+.1f", 100.0, f" ({p_value(test['p_value'])})")
    return [
        f"{row['both_succeed']}",
        spread(found["flight_time_s"], 3),
        spread(found["energy_regression_j"], 2),
        spread(found["response_median_s"], 2),
        points,
    ]


def _cost_cells(row: Row) -> list[str]:
    over = row["over_own"]
    return [
        f"{row['pairs']}", f"{row['lost']}", spread(row["cost_s"]["mean"], 2),
        spread(over["p95"], 3), number(over["largest"], ".3f"), percent(over["recovered_share"]),
    ]  # fmt: skip


def _extra_cells(row: Row) -> list[str]:
    return [
        f"{row['pairs']}", f"{row['differ']}", spread(row["extra_s"], 2, chance=row["p_value"]),
        spread(row["p95_ratio"], 3), number(row["largest_ratio"], ".3f"),
        number(row["longest_ratio"], ".3f"),
    ]  # fmt: skip


def _worst_cells(row: Row) -> list[str]:
    over = number(row["over_mean_ratio"], ".3f")
    return [number(row["worst_s"], ".1f"), over, percent(row["over_mean_recovered_share"])]


def _again(told: Row) -> list[str]:
    titles, lines = _titles_of(told), []
    for row in told["costs"]:
        if row["setting"] != NONE or row["worst_flight"] is None:
            continue
        if row["over_own"]["largest"] > 1.0:
            lines.append(f"the fault that costs most on {titles[row['platform']]}:")
            lines.append(f"  {_command_of(told['plan'], row)}")
        else:
            lines.append(f"no fault made a flight longer on {titles[row['platform']]}")
    return [*lines, *([PAPER] if told["plan"]["inject"] else [])]


def _command_of(plan: Row, row: Row) -> str:
    flight = row["worst_flight"]
    words = ["mavfi", "fly", "--world", plan["world"], "--seed", f"{flight['seed']}"]
    words += ["--platform", row["platform"]]
    if plan["stack"] != DEFAULT:
        words += ["--stack", plan["stack"]]
    if flight["target"]:
        words += ["--inject", flight["target"], "--fault-seed", f"{flight['fault_seed']}"]
        words += [] if plan["field"] is None else ["--field", plan["field"]]
    return shlex.join(words)


# Rows -----------------------------------------------------------------------------------------


_NAMES = ("table", "platform", "reference", "setting", "quantity", "statistic", "unit", "value",
          "low", "high", "count")  # fmt: skip
# Quantity, statistic and unit of a number, and its path in the row.
_OF_COSTS = (
    ("lost by faults", "flights", "count", ("lost",)),
    ("cost of a fault", "mean", "s", ("cost_s", "mean")),
    ("cost of a fault", "largest", "s", ("cost_s", "largest")),
    ("flight time over own golden", "95th percentile", "1", ("over_own", "p95")),
    ("flight time over own golden", "largest", "1", ("over_own", "largest")),
    ("flight time over own golden", "share of the largest increase recovered", "1",
     ("over_own", "recovered_share")),
)  # fmt: skip
_OF_DIFFERENCES = (
    ("cost of a fault", "mean difference", "s", ("extra_s",)),
    ("cost of a fault", "pairs that differ", "count", ("differ",)),
    ("cost of a fault", "p-value of the mean difference", "1", ("p_value",)),
    ("flight time over own golden", "ratio of 95th percentiles", "1", ("p95_ratio",)),
    ("flight time over own golden", "ratio of the largest", "1", ("largest_ratio",)),
    ("flight time", "ratio of the longest", "1", ("longest_ratio",)),
)
_OF_WORST = (
    ("flight time", "largest", "s", ("worst_s",)),
    ("flight time", "largest over mean golden", "1", ("over_mean_ratio",)),
    ("flight time", "share of the increase over mean golden recovered", "1",
     ("over_mean_recovered_share",)),
)  # fmt: skip


def platform_csv(told: Row) -> str:
    """One row per number: quantity, platform, setting, unit, value and interval."""
    rows = [*_setting_numbers(told["settings"]), *_ratio_numbers(told["ratios"])]
    for row in told["costs"]:
        counts = {"lost": row["pairs"] + row["lost"]}
        rows += _numbers("costs", row, _OF_COSTS, counts, row["pairs"])
    for row in told["cost_differences"]:
        counts = dict.fromkeys(("differ", "p_value"), row["pairs"])
        rows += _numbers("costs", row, _OF_DIFFERENCES, counts)
    for row in told["worst"]:
        rows += _numbers("worst", row, _OF_WORST, {}, row["flights"])
    blank = (
        {key: "" if isinstance(cell, float) and math.isnan(cell) else cell
         for key, cell in row.items()}
        for row in rows
    )  # fmt: skip
    return Table.of_records(blank, _NAMES).csv()


def _at(table: str, row: Row, quantity: str, statistic: str, unit: str) -> dict[str, Any]:
    labels = {name: row[name] for name in ("platform", "reference", "setting") if name in row}
    return {"table": table, **labels, "quantity": quantity, "statistic": statistic, "unit": unit}


def _setting_numbers(rows: Iterable[Row]) -> Iterator[dict[str, Any]]:
    for row in rows:
        success = row["success"]
        yield {**_at("settings", row, "success", "share", "1"), "value": success["share"],
               "low": success["low"], "high": success["high"],
               "count": success["total"]}  # fmt: skip
        for each in QUANTITIES:
            found = row["quantities"][each.name]
            for statistic in ("median", "mean"):
                told = _at("settings", row, each.title, statistic, each.unit)
                yield {**told, **found[statistic]}


def _ratio_numbers(rows: Iterable[Row]) -> Iterator[dict[str, Any]]:
    for row in rows:
        yield {**_at("ratios", row, "success", "difference", "1"),
               "value": row["success"]["difference"], "count": row["pairs"]}  # fmt: skip
        for each in QUANTITIES:
            found = dict(row["quantities"][each.name])
            kind, unit = found.pop("kind"), found.pop("unit")
            told = _at("ratios", row, each.title, kind, "1" if kind == "ratio" else unit)
            yield {**told, **found}


def _numbers(
    table: str, row: Row, listed: Any, counts: Mapping[str, int], count: int | None = None
) -> Iterator[dict[str, Any]]:
    """The listed numbers of a row.

    Args:
        counts: sample sizes, by the first word of a number's path.
        count: sample size of numbers without their own.
    """
    for quantity, statistic, unit, place in listed:
        found: Any = row
        for name in place:
            found = found[name]
        values = dict(found) if isinstance(found, Mapping) else {"value": found}
        if "count" not in values and (of := counts.get(place[0], count)) is not None:
            values["count"] = of
        yield {**_at(table, row, quantity, statistic, unit), **values}
