"""Platforms beside each other: as text, and as CSV with a row a number."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mavfi_cli.analysis.platforms import GOLDEN, NONE, QUANTITIES
from mavfi_cli.core.columns import columns
from mavfi_cli.mission.stack import DEFAULT
from mavfi_cli.report.tables.rows import csv_text
from mavfi_cli.stats.bootstrap import FEW

Row = Mapping[str, Any]
# The paper, section VII-E: on the TX2, a single bit flip in an inter-kernel state.
PAPER = "paper, Fig. 16: worst case x 2.8 on the TX2, of which GAD recovers 79.3 %, AAD 88.0 %"


def setting_title(setting: str) -> str:
    """What a setting is called."""
    return {GOLDEN: "golden", NONE: "faults"}.get(setting, f"faults, {setting}")


def platform_lines(told: Row) -> list[str]:
    """The comparison in words and columns."""
    lines = _head(told)
    lines += ["", "Flights that count: golden, or with a fault that was read or caught; medians"]
    lines += _columns(_flight_rows(told))
    lines += ["", *_columns(_work_rows(told))]
    for platform in told["plan"]["platforms"][1:]:
        lines += ["", *_ratio_lines(told, platform)]
    if told["costs"]:
        lines += [
            "",
            "What faults cost (Fig. 16), over the mission's golden flight; both successful",
        ]
        lines += _columns(_cost_rows(told))
        for platform in told["plan"]["platforms"][1:]:
            lines += ["", *_difference_lines(told, platform)]
    lines += ["", "The longest successful flights"]
    lines += _columns(_worst_rows(told))
    lines += _again(told)
    share = 100 * told["confidence"]
    lines.append("")
    if told["errors"]:
        lines.append(f"{len(told['errors'])} missions could not be flown.")
    return [
        *lines,
        f"In brackets: {share:g} % intervals, Wilson for success, bootstrap for the rest.",
        "Energy: the paper's regression; that of the propellers is in compare.json.",
        "Response, depth frame to setpoint: each flight's median and 95th percentile; here the",
        "median over the flights.",
        *_few(told),
    ]


def _few(told: Row) -> list[str]:
    """A word where intervals are of too few flights to be believed."""
    counts = [row["quantities"]["flight_time_s"]["mean"]["count"] for row in told["settings"]]
    if not any(1 < count < FEW for count in counts):
        return []
    return [f"Bootstrap intervals of fewer than {FEW} flights are too narrow to be believed."]


def _head(told: Row) -> list[str]:
    plan = told["plan"]
    last = plan["first_seed"] + plan["missions"] - 1
    lines = [
        f"Missions    {plan['missions']} in {plan['world']}, seeds {plan['first_seed']} to {last}, "
        "the same on each platform",
        f"Stack       {plan['stack']}",
        f"Faults      {_faults(plan)}",
    ]
    for number, row in enumerate(plan["platforms"]):
        head = "Platforms" if number == 0 else ""
        lines.append(f"{head:<11} {row['title']}: {row['description']}, {row['cores']} cores")
    return lines


def _faults(plan: Row) -> str:
    if not plan["inject"]:
        return "none"
    bits = "one bit" if plan["field"] is None else f"one bit of the {plan['field']}"
    return f"{bits} in {', '.join(plan['inject'])}: one a flight; fault seed {plan['seed']}"


def titles_of(told: Row) -> dict[str, str]:
    """What the platforms are called."""
    return {row["platform"]: row["title"] for row in told["plan"]["platforms"]}


def _flight_rows(told: Row) -> Iterator[list[str]]:
    yield ["", "", "flights", "success", "flight time, s", "distance, m"]
    for row, name, title in _settings(told):
        found = row["quantities"]
        yield [
            name,
            title,
            f"{row['counted']} of {row['flown']}",
            _rate(row["success"]),
            _spread(found["flight_time_s"]["median"], digits=1),
            _spread(found["distance_m"]["median"], digits=1),
        ]


def _work_rows(told: Row) -> Iterator[list[str]]:
    yield [
        "",
        "",
        "energy, kJ",
        "replans (mean)",
        "response, ms",
        "95th perc., ms",
    ]
    for row, name, title in _settings(told):
        found = row["quantities"]
        yield [
            name,
            title,
            _spread(found["energy_regression_j"]["median"], scale=1e-3, digits=1),
            _spread(found["replans"]["mean"], digits=1),
            _spread(found["response_median_s"]["median"], scale=1e3, digits=0),
            _spread(found["response_p95_s"]["median"], scale=1e3, digits=0),
        ]


def _settings(told: Row) -> Iterator[tuple[Row, str, str]]:
    """Each row with its setting, once, and its platform."""
    titles, last = titles_of(told), ""
    for row in told["settings"]:
        name = setting_title(row["setting"])
        yield row, "" if name == last else name, titles[row["platform"]]
        last = name


def _ratio_lines(told: Row, platform: Row) -> list[str]:
    rows = [row for row in told["ratios"] if row["platform"] == platform["platform"]]
    reference = titles_of(told)[rows[0]["reference"]]
    title = f"{platform['title']} over {reference}, mission by mission"
    return [
        f"{title} (flights that both succeed in; response: all)",
        *_columns(_ratio_rows(rows)),
    ]


def _ratio_rows(rows: Sequence[Row]) -> Iterator[list[str]]:
    yield ["", "pairs", "flight time, x", "energy, x", "response, x", "success, pts"]
    for row in rows:
        found = row["quantities"]
        difference = row["success"]["difference"]
        yield [
            setting_title(row["setting"]),
            f"{row['both_succeed']}",
            _spread(found["flight_time_s"], digits=3),
            _spread(found["energy_regression_j"], digits=2),
            _spread(found["response_median_s"], digits=2),
            "-"
            if math.isnan(difference)
            else f"{100 * difference:+.1f} ({_chance(row['success']['p_value'])})",
        ]


def _platforms(told: Row, rows: Sequence[Row]) -> Iterator[tuple[Row, str]]:
    """Each row with its platform, once."""
    titles, last = titles_of(told), ""
    for row in rows:
        title = titles[row["platform"]]
        yield row, "" if title == last else title
        last = title


def _cost_rows(told: Row) -> Iterator[list[str]]:
    yield ["", "", "flights", "lost", "mean, s", "95th perc., x", "worst, x",
           "recovered"]  # fmt: skip
    for row, title in _platforms(told, told["costs"]):
        yield [
            title,
            setting_title(row["setting"]),
            f"{row['pairs']}",
            f"{row['lost']}",
            _spread(row["cost_s"]["mean"], digits=2),
            _spread(row["over_own"]["p95"], digits=3),
            _number(row["over_own"]["largest"], "{:.3f}"),
            _number(row["over_own"]["recovered_share"], "{:.1%}"),
        ]


def _difference_lines(told: Row, platform: Row) -> list[str]:
    """How much more the same faults cost on another platform than on the first."""
    rows = [row for row in told["cost_differences"] if row["platform"] == platform["platform"]]
    reference = titles_of(told)[rows[0]["reference"]]
    title = f"{platform['title']} against {reference}, fault by fault"
    return [
        f"{title} (faults that both survive; worst, longest: of all)",
        *_columns(_difference_rows(rows)),
    ]


def _difference_rows(rows: Sequence[Row]) -> Iterator[list[str]]:
    yield ["", "pairs", "differ", "mean, s", "95th perc., x", "worst, x", "longest, x"]
    for row in rows:
        yield [
            setting_title(row["setting"]),
            f"{row['pairs']}",
            f"{row['differ']}",
            _spread(row["extra_s"], digits=2, chance=row["p_value"]),
            _spread(row["p95_ratio"], digits=3),
            _number(row["largest_ratio"], "{:.3f}"),
            _number(row["longest_ratio"], "{:.3f}"),
        ]


def _worst_rows(told: Row) -> Iterator[list[str]]:
    yield ["", "", "longest, s", "over mean golden, x", "recovered"]
    for row, title in _platforms(told, told["worst"]):
        yield [
            title,
            setting_title(row["setting"]),
            _number(row["worst_s"], "{:.1f}"),
            _number(row["over_mean_ratio"], "{:.3f}"),
            _number(row["over_mean_recovered_share"], "{:.1%}"),
        ]


def _again(told: Row) -> list[str]:
    """How to fly again what cost most."""
    titles, lines = titles_of(told), []
    for row in told["costs"]:
        if row["setting"] != NONE or row["worst_flight"] is None:
            continue
        if row["over_own"]["largest"] > 1.0:
            lines.append(f"the fault that costs most on {titles[row['platform']]}:")
            lines.append(f"  {command_of(told, row)}")
        else:
            lines.append(f"no fault made a flight longer on {titles[row['platform']]}")
    return [*lines, *([PAPER] if told["plan"]["inject"] else [])]


def command_of(told: Row, row: Row) -> str:
    """The command that flies the worst flight of a setting without detector again."""
    plan, flight = told["plan"], row["worst_flight"]
    parts = [
        f"mavfi fly --world {plan['world']} --seed {flight['seed']} --platform {row['platform']}"
    ]
    if plan["stack"] != DEFAULT:
        parts.append(f"--stack {shlex.quote(plan['stack'])}")
    if flight["target"]:
        parts.append(f"--inject {flight['target']} --fault-seed {flight['fault_seed']}")
        parts += [] if plan["field"] is None else [f"--field {plan['field']}"]
    return " ".join(parts)


# Cells --------------------------------------------------------------------------------------------


def _columns(rows: Iterator[list[str]]) -> list[str]:
    """Rows as text: the first columns to the left, numbers to the right."""
    cells = list(rows)
    return columns(cells, 2 if cells[0][1] == "" else 1)


def _chance(p_value: float) -> str:
    """A p-value in little room."""
    return "p<.001" if p_value < 0.001 else f"p {p_value:.1g}".replace("p 0.", "p .")


def _rate(share: Row) -> str:
    if math.isnan(share["share"]):
        return "-"
    ends = f"({100 * share['low']:.0f} to {100 * share['high']:.0f})"
    return f"{100 * share['share']:.1f} % {ends}"


def _spread(each: Row, *, scale: float = 1.0, digits: int, chance: float | None = None) -> str:
    """A value with its interval, and the p-value where one is given."""
    value, low, high = (scale * each[name] for name in ("value", "low", "high"))
    if math.isnan(value):
        return "-"
    told = [] if math.isnan(low) else [f"{low:z.{digits}f} to {high:z.{digits}f}"]
    told += [] if chance is None else [_chance(chance)]
    ends = f" ({', '.join(told)})" if told else ""
    return f"{value:z.{digits}f}{ends}"


def _number(value: float, shape: str) -> str:
    return "-" if math.isnan(value) else shape.format(value).replace("%", " %")


# Rows -------------------------------------------------------------------------------------------


_NAMES = ("table", "platform", "reference", "setting", "quantity", "statistic", "unit", "value",
          "low", "high", "count")  # fmt: skip


def platform_csv(told: Row) -> str:
    """A row a number: what it is, of which platform and setting, its unit and its interval."""
    return csv_text(
        ({key: "" if isinstance(cell, float) and math.isnan(cell) else cell
          for key, cell in row.items()}
         for row in _csv_rows(told)),
        _NAMES,
    )  # fmt: skip


def _csv_rows(told: Row) -> Iterator[dict[str, Any]]:
    for row in told["settings"]:
        at = {"table": "settings", "platform": row["platform"], "setting": row["setting"]}
        success = row["success"]
        yield {**at, "quantity": "success", "statistic": "share", "unit": "1",
               "value": success["share"], "low": success["low"], "high": success["high"],
               "count": success["total"]}  # fmt: skip
        for quantity in QUANTITIES:
            found = row["quantities"][quantity.name]
            for statistic in ("median", "mean"):
                yield {**at, "quantity": quantity.title, "statistic": statistic,
                       "unit": quantity.unit, **found[statistic]}  # fmt: skip
    for row in told["ratios"]:
        at = {"table": "ratios", **{k: row[k] for k in ("platform", "reference", "setting")}}
        yield {**at, "quantity": "success", "statistic": "difference", "unit": "1",
               "value": row["success"]["difference"], "count": row["pairs"]}  # fmt: skip
        for quantity in QUANTITIES:
            found = dict(row["quantities"][quantity.name])
            kind = found.pop("kind")
            unit = "1" if kind == "ratio" else found["unit"]
            yield {**at, "quantity": quantity.title, **found, "statistic": kind, "unit": unit}
    for row in told["costs"]:
        at = {"table": "costs", "platform": row["platform"], "setting": row["setting"]}
        yield from _cost_csv(at, row)
    for row in told["cost_differences"]:
        at = {"table": "costs", **{k: row[k] for k in ("platform", "reference", "setting")}}
        yield {**at, "quantity": "cost of a fault", "statistic": "mean difference", "unit": "s",
               **row["extra_s"]}  # fmt: skip
        yield {**at, "quantity": "cost of a fault", "statistic": "pairs that differ",
               "unit": "count", "value": row["differ"], "count": row["pairs"]}  # fmt: skip
        yield {**at, "quantity": "cost of a fault", "statistic": "p-value of the mean difference",
               "unit": "1", "value": row["p_value"], "count": row["pairs"]}  # fmt: skip
        yield {**at, "quantity": "flight time over own golden", "unit": "1",
               "statistic": "ratio of 95th percentiles", **row["p95_ratio"]}  # fmt: skip
        yield {**at, "quantity": "flight time over own golden", "statistic": "ratio of the largest",
               "unit": "1", "value": row["largest_ratio"]}  # fmt: skip
        yield {**at, "quantity": "flight time", "statistic": "ratio of the longest", "unit": "1",
               "value": row["longest_ratio"]}  # fmt: skip
    for row in told["worst"]:
        at = {"table": "worst", "platform": row["platform"], "setting": row["setting"],
              "quantity": "flight time", "count": row["flights"]}  # fmt: skip
        for statistic, unit, key in _WORST:
            yield {**at, "statistic": statistic, "unit": unit, "value": row[key]}


def _cost_csv(at: dict[str, Any], row: Row) -> Iterator[dict[str, Any]]:
    cost, over, pairs = row["cost_s"], row["over_own"], {"count": row["pairs"]}
    yield {**at, "quantity": "lost by faults", "statistic": "flights", "unit": "count",
           "value": row["lost"], "count": row["pairs"] + row["lost"]}  # fmt: skip
    of_cost = {**at, "quantity": "cost of a fault", "unit": "s"}
    yield {**of_cost, "statistic": "mean", **cost["mean"]}
    yield {**of_cost, "statistic": "largest", "value": cost["largest"], **pairs}
    of_ratio = {**at, "quantity": "flight time over own golden", "unit": "1"}
    yield {**of_ratio, "statistic": "95th percentile", **over["p95"]}
    yield {**of_ratio, "statistic": "largest", "value": over["largest"], **pairs}
    yield {**of_ratio, "statistic": "share of the largest increase recovered",
           "value": over["recovered_share"], **pairs}  # fmt: skip


_WORST = (
    ("largest", "s", "worst_s"),
    ("largest over mean golden", "1", "over_mean_ratio"),
    ("share of the increase over mean golden recovered", "1", "over_mean_recovered_share"),
)
