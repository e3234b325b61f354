"""A comparison as rows for other programs: CSV, a row a number."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping
from typing import Any

from mavfi_cli.campaign.compare.figures import QUANTITIES

Row = Mapping[str, Any]
_NAMES = ("table", "platform", "reference", "setting", "quantity", "statistic", "unit", "value",
          "low", "high", "count")  # fmt: skip


def rows_csv(told: Row) -> str:
    """A row a number: what it is, of which platform and setting, its unit and its interval."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=list(_NAMES), lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows(
        {key: "" if isinstance(cell, float) and math.isnan(cell) else cell
         for key, cell in row.items()}
        for row in _csv_rows(told)
    )  # fmt: skip
    return buffer.getvalue()


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
