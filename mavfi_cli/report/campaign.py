"""A campaign as text: settings, comparisons, quality of flight, overhead, failures."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from mavfi_cli.analysis.summary import INACTIVE, METRICS
from mavfi_cli.campaigns.missions import label_text, label_value, ordered
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.measures import HOST_CHECKS
from mavfi_cli.report.columns import blocks, number, percent, spread
from mavfi_cli.stats.paired import McNemar

Row = Mapping[str, Any]
_STAGES = tuple(stage.value for stage in Stage)
_TITLES = {
    "flight_time_s": ("flight time, s", 1.0),
    "distance_m": ("distance, m", 1.0),
    "energy_regression_j": ("energy (paper's regression), kJ", 1e-3),
    "replans": ("replans", 1.0),
}


def campaign_lines(told: Row) -> list[str]:
    """The parts that the plain values of a campaign have.

    Args:
        told: `analysis.summary.summarise`, and any of `quality` of `qualities`, `overhead` of
            `flight_overheads`, `failures` of `failures`.
    """
    confidence, lines = told.get("confidence", 0.95), []
    if "cells" in told:
        lines += _summary(told)
    if "quality" in told:
        lines += _quality(told["quality"], confidence)
    if "overhead" in told:
        lines += _overhead(told["overhead"], confidence)
    if "failures" in told:
        lines += ["", "injected faults that fail missions which succeed without:"]
        if not told["failures"]:
            lines.append("  none: no setting has struck missions and golden flights of them")
        for each in told["failures"]:
            lines += [f"  {each['name']}", *(f"    {part}" for part in _parts(each))]
    return lines


# Settings as rows: a column per distinguishing label; common labels are printed once ------------


@dataclass(frozen=True, slots=True)
class SettingColumns:
    """Columns and common labels of some settings.

    Attributes:
        keys: the labels that have a column, in order.
        common: other labels, which have one value in all settings that have them.
    """

    keys: tuple[str, ...]
    common: Mapping[str, Any]

    @classmethod
    def of(cls, settings: Sequence[Mapping[str, Any]]) -> SettingColumns:
        """The columns of settings, from their labels. They differ without the common ones.

        A single setting has no columns, because its name is enough.
        """
        if len(settings) == 1:
            return cls((), {})
        keys = ordered({key for labels in settings for key in labels})
        common: dict[str, Any] = {}
        for key in reversed(keys):
            values = {label_value(labels[key]): labels[key] for labels in settings if key in labels}
            left = [each for each in keys if each not in common and each != key]
            apart = {tuple(_cells(labels, left)) for labels in settings}
            if len(values) == 1 and len(apart) == len(settings):
                (common[key],) = values.values()
        return cls(tuple(key for key in keys if key not in common), common)

    @property
    def heads(self) -> tuple[str, ...]:
        """Headings of the labels' columns."""
        return self.keys or ("setting",)

    def told(self) -> list[str]:
        """The line of common labels above a table; no line if there are none."""
        return [f"in all settings that have it: {label_text(self.common)}"] if self.common else []

    def table(
        self, head: Sequence[str], rows: Sequence[tuple[Mapping[str, Any], str, Sequence[str]]]
    ) -> list[str]:
        """One line per setting, in several tables if the screen is too narrow.

        Args:
            head: head of the cells.
            rows: labels, name and cells of each setting.
        """
        labels = [self.cells(labels, name) for labels, name, _ in rows]
        heads = list(self.heads)
        told = [[*own, *cells] for own, (_, _, cells) in zip(labels, rows, strict=True)]
        return blocks([[*heads, *head], *told], len(heads))

    def cells(self, labels: Mapping[str, Any], name: str) -> list[str]:
        """The cells of a setting's labels; the first empty one has the rest of its name."""
        if not self.keys:
            return [name]
        cells = _cells(labels, self.keys)
        beyond = name.removeprefix(label_text(labels)).strip()
        if beyond and "" in cells:
            cells[cells.index("")] = beyond
        return cells


def _cells(labels: Mapping[str, Any], keys: Sequence[str]) -> list[str]:
    return [label_value(labels[key]) if key in labels else "" for key in keys]


# Settings and comparisons ---------------------------------------------------------------------


def _summary(summary: Row) -> list[str]:
    settings = SettingColumns.of([cell["labels"] for cell in summary["cells"]])
    fates = [(cell["labels"], cell["name"], _fate_cells(cell)) for cell in summary["cells"]]
    means = [(cell["labels"], cell["name"], _mean_cells(cell)) for cell in summary["cells"]]
    otherwise = ["ended otherwise"] if any(cells[-1] for _, _, cells in fates) else []
    head = ["over", "success", _sure(summary["confidence"]), "of all", "inactive", *otherwise]
    lines = [
        *settings.told(),
        *settings.table(head, fates),
        "",
        *settings.table(["mean time", "mean distance", "mean energy", "mean replans"], means),
    ]
    for title, comparisons in (
        ("against the golden flights of the same missions:", summary["faults"]),
        ("against the same faults without protection:", summary["protection"]),
    ):
        if comparisons:
            lines += ["", title, *_comparison_table(settings, comparisons)]
    return lines


def _sure(confidence: float) -> str:
    return f"{100 * confidence:g} % interval"


def _fate_cells(cell: Row) -> list[str]:
    over = sum(cell["outcomes"].values()) + cell["errors"]
    share = cell["success"]
    ends = f"{100 * share['low']:.1f} to {100 * share['high']:.1f} %" if share["total"] else "-"
    told = [f"{name} {count}" for name, count in cell["outcomes"].items() if name != "success"]
    told += [f"{name.replace('_', ' ')} {count}"
             for name, count in cell["injected"].items() if name in INACTIVE]  # fmt: skip
    told += [f"could not begin {cell['errors']}"] if cell["errors"] else []
    return [f"{over}/{cell['planned']}", f"{share['count']}/{share['total']}", ends,
            percent(cell["every"]["share"]), str(cell["inactive"]["total"]),
            ", ".join(told)]  # fmt: skip


def _mean_cells(cell: Row) -> list[str]:
    units = zip(METRICS, (1.0, 1.0, 1e-3, 1.0), (" s", " m", " kJ", ""), strict=True)
    means = cell["metrics"]
    return [number(means[name]["value"], ".1f", scale, unit) for name, scale, unit in units]


def _comparison_table(settings: SettingColumns, found: Sequence[Row]) -> list[str]:
    head = ["pairs", "success, points", "p", "time, s", "worst over own golden",
            "worst over mean golden"]  # fmt: skip
    cells = [_comparison_cells(each) for each in found]
    used = [place for place, column in enumerate(zip(*cells, strict=True)) if any(column)]
    rows = [
        (each["second"], each["name"], [row[place] for place in used])
        for each, row in zip(found, cells, strict=True)
    ]
    return settings.table([head[place] for place in used], rows)


def _comparison_cells(each: Row) -> list[str]:
    """Success, time, and worst cases; the one over the mean golden flight for protection only."""
    test, time, mean = McNemar(**each["success"]), each["differences"]["flight_time_s"], "over_mean"
    return [
        f"{test.pairs}",
        f"{100 * test.difference:+.1f}",
        f"{each['corrected_p']:.3g}",
        "" if math.isnan(time["low"]) else spread(time, 2, sign="+"),
        _worst(each["over_own"]),
        "" if math.isnan(each[mean]["recovered_share"]) else _worst(each[mean]),
    ]


def _worst(worst: Row) -> str:
    if math.isnan(worst["increase"]):
        return ""
    told = percent(worst["increase"], "+.1f")
    if math.isnan(worst["recovered_share"]):
        return told
    points = number(worst["recovered"], ".1f", 100.0, " points")
    return f"{told}, recovered {points}, {percent(worst['recovered_share'])}"


# Quality of flight ----------------------------------------------------------------------------


def _quality(found: Sequence[Row], confidence: float) -> list[str]:
    if not found:
        return []
    first = [each["labels"] for each in found if each["metric"] == METRICS[0]]
    settings = SettingColumns.of(first)
    head = ["flights", f"mean ({_sure(confidence)})", "least", "median", "most", "to golden"]
    told = []
    for metric, (title, scale) in _TITLES.items():
        rows = [
            (each["labels"], each["name"], _quality_cells(each, scale))
            for each in found
            if each["metric"] == metric
        ]
        told += ["", title, *settings.table(head, rows)]
    return told


def _quality_cells(each: Row, scale: float) -> list[str]:
    extremes = (each["least"], each["median"], each["most"])
    return [
        f"{each['mean']['count']}",
        spread(each["mean"], 2, scale),
        *(number(value, ".2f", scale) for value in extremes),
        "" if each["difference"] is None else spread(each["difference"], 2, scale, "+"),
    ]


# Overhead -------------------------------------------------------------------------------------


def _overhead(found: Sequence[Row], confidence: float) -> list[str]:
    if not found:
        return ["", "overhead: no flight with a detector"]
    settings = SettingColumns.of([each["labels"] for each in found])
    sure = f"({_sure(confidence)})"
    named = [(each, (each["labels"], label_text(each["labels"]))) for each in found]
    return [
        "", "detection: checks, host time", *settings.told(),
        *settings.table(
            ["flights", "a second", f"us each {sure}", f"% of time {sure}"],
            [(*name, _detection_cells(each)) for each, name in named],
        ),
        f"({HOST_CHECKS})",
        "", "recovery: % of flight time, simulated",
        *settings.table(
            ["times", *_STAGES, f"in all {sure}", f"+ checks {sure}"],
            [(*name, _recovery_cells(each)) for each, name in named],
        ),
    ]  # fmt: skip


def _detection_cells(each: Row) -> list[str]:
    return [
        f"{each['flights']}",
        f"{each['checks_per_s']['value']:.1f}",
        spread(each["check_host_s"], 2, 1e6),
        _percent(each["detection_host_share"]),
    ]


def _recovery_cells(each: Row) -> list[str]:
    return [
        f"{round(math.fsum(each['recomputations'].values()))}",
        *(_percent(each["recovery_share"][stage], ends=False) for stage in _STAGES),
        _percent(each["recovery_share_in_all"]),
        _percent(each["share_in_all"]),
    ]


def _percent(share: Row, *, ends: bool = True) -> str:
    """Per cent with four decimals, as in the paper's table; smaller positive values as "<"."""
    value, *between = spread(share, 4, 100.0).split(" ", 1)
    told = "<0.0001" if 0.0 < share["value"] < 0.5e-6 else value
    return " ".join([told, *between]) if ends else told


# Failures -------------------------------------------------------------------------------------


def _parts(each: Row) -> list[str]:
    failure, layers = each["failure"], each["layers"]
    parts = [f"{failure['count']} of {failure['total']} faults fail the mission, {_share(failure)}"]
    if layers is not None:
        parts.append(f"{each['kernel']} corrupted by {_share(layers['corruption'])} of its faults")
        given = layers["failure_given_corruption"]
        if given is None:
            parts.append("failure given corruption unknown: more fail than are corrupted")
        else:
            parts.append("failure given corruption {:.3g} ({:.3g} to {:.3g})".format(*given))
    if each["per_hour"] is not None:
        parts.append("{:.3g} failures a flight hour ({:.3g} to {:.3g})".format(*each["per_hour"]))
    return parts


def _share(share: Row) -> str:
    ends = f"({100 * share['low']:.1f} to {100 * share['high']:.1f})"
    return f"{percent(share['share'])} {ends}"


# Export ---------------------------------------------------------------------------------------


def flights_file(table: pa.Table, path: Path) -> bytes:
    """The content of a .parquet or .csv file with an exported table; that of `-` is CSV.

    Raises:
        ConfigError: the file has another suffix.
    """
    from pyarrow import csv, parquet

    content = io.BytesIO()
    if path.suffix == ".parquet":
        parquet.write_table(table, content, compression="zstd")
    elif path.suffix == ".csv" or path == Path("-"):
        csv.write_csv(_flat(table), content)
    else:
        problem = "the name must end in .parquet or .csv, or - for CSV on stdout"
        raise ConfigError(problem, path=path)
    return content.getvalue()


def _flat(table: pa.Table) -> pa.Table:
    """A table without lists, which CSV does not have: they become JSON."""
    for place, field in enumerate(table.schema):
        if pa.types.is_list(field.type):
            texts = [
                None if each is None else json.dumps(each) for each in table[place].to_pylist()
            ]
            table = table.set_column(place, field.name, pa.array(texts, pa.string()))
    return table
