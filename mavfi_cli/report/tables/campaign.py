"""A campaign as text: settings, comparisons, quality of flight, overhead, failures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from mavfi_cli.analysis.groups import INACTIVE, METRICS
from mavfi_cli.campaigns.missions import label_text
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.record.detection_cost import HOST_CHECKS
from mavfi_cli.report.tables.columns import number, percent, spread
from mavfi_cli.report.tables.settings import SettingColumns
from mavfi_cli.stats.paired import McNemar

Row = Mapping[str, Any]
_STAGES = tuple(stage.value for stage in Stage)
_TITLES = {
    "flight_time_s": ("flight time, s", 1.0),
    "distance_m": ("distance, m", 1.0),
    "energy_regression_j": ("energy (paper's regression), kJ", 1e-3),
    "replans": ("replans", 1.0),
}


# Settings and comparisons ---------------------------------------------------------------------


def summary_lines(summary: Row) -> list[str]:
    """The settings and the comparisons."""
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
    """One line per comparison, without empty columns."""
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


def quality_lines(found: Sequence[Row], confidence: float = 0.95) -> list[str]:
    """One table per metric."""
    if not found:
        return []
    settings = SettingColumns.of([each["labels"] for each in found if each["metric"] == METRICS[0]])
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


def overhead_lines(found: Sequence[Row], confidence: float = 0.95) -> list[str]:
    """A table of detection, measured on the host, and a table of recovery, simulated."""
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


def failure_lines(rows: Sequence[Row]) -> list[str]:
    """One setting, with a line for each number."""
    return [
        line for each in rows for line in (f"  {each['name']}", *(f"    {p}" for p in _parts(each)))
    ]


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
