"""An evaluation of detectors as text, and its pairs as CSV."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pyarrow as pa

from mavfi_cli.analysis.detector_pairs import CSV, NONE
from mavfi_cli.analysis.detectors import ALL
from mavfi_cli.report.tables.columns import (
    columns,
    csv_text,
    number,
    percent,
    rate,
    spread,
)

Row = Mapping[str, Any]
_INTERVALS = "in brackets: 95 % intervals (Wilson for shares, bootstrap for the rest)"


def detector_lines(evaluation: Row) -> list[str]:
    """The evaluation in words and columns."""
    lines = _head(evaluation)
    lines += ["", "Without faults, against the same flights without a detector"]
    lines += columns(_error_free_rows(_of(evaluation["error_free"], ALL)))
    faults = _of(evaluation["faults"], ALL)
    if not faults or not faults[0]["planned"]:
        return lines
    lines += ["", "Faults: detection, by an alarm at or after the strike"]
    lines += columns(_detection_rows(faults, evaluation["curves"]))
    lines += ["", "Faults: recovery"]
    lines += columns(_recovery_rows(faults))
    lines += ["", *columns(_worst_rows(_of(evaluation["faults"], "world")))]
    for by in ("world", "stage", "field", "state"):
        rows = columns(_group_rows(by, _of(evaluation["faults"], by)))
        lines += ["", *rows] if len(rows) > 1 else []
    lines += ["", *columns(_comparison_rows(evaluation["comparisons"]))]
    return [*lines, _INTERVALS]


def _of(rows: Sequence[Row], by: str) -> list[Row]:
    return [row for row in rows if row["by"] == by]


def _head(evaluation: Row) -> list[str]:
    plan = evaluation["plan"]
    faults = _of(evaluation["faults"], ALL)
    lines = [
        f"Flights     {', '.join(plan['worlds'])}: {plan['golden_flights']} error-free missions "
        f"each, {plan['flights']} of them with",
        f"            a fault at each of {len(plan['places'])} kinds of places; {plan['level']} "
        f"level, from seed {plan['first_seed']} on",
        f"Detectors   {', '.join([NONE, *plan['detectors']])}, on {', '.join(plan['protect'])}",
    ]
    if faults:
        row = faults[0]
        lines += [
            f"Faults      {row['planned']}: {row['not_injected']} not injected, "
            f"{row['not_activated']} not activated, {row['active']} active",
            f"            {row['harmful']['count']} harmful: {row['lost']} lost the mission, "
            f"{row['longer']} took over 5 % longer, {row['otherwise']} failed otherwise",
        ]
        if row["crashed"]:
            lines.append(f"            {row['crashed']} of the active ones killed a node")
    if evaluation["errors"]:
        lines.append(f"            {len(evaluation['errors'])} missions could not be flown")
    return lines


def _watched(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["detector"] != NONE]


def _error_free_rows(rows: Sequence[Row]) -> Iterator[list[str]]:
    yield ["", "flights", "alarms an hour", "with an alarm", "missions lost", "longer (median), %"]
    for row in _watched(rows):
        yield [
            row["detector"],
            f"{row['flights']}",
            spread(row["alarms_per_hour"], 1),
            _share(row["with_alarm"]),
            _fraction(row["lost"]) + (f", {row['gained']} won" if row["gained"] else ""),
            spread(row["lengthening"], 2, 100.0),
        ]


def _detection_rows(rows: Sequence[Row], curves: Row) -> Iterator[list[str]]:
    yield ["", "harmful", "all active", "by chance", "ticks (95th)", "ROC area"]
    for row in _watched(rows):
        found = curves[row["detector"]]
        yield [
            row["detector"],
            _share(row["detected_harmful"]),
            rate(row["detected_active"]),
            percent(row["by_chance"]["share"]),
            f"{number(row['latency_ticks'], '.0f')} ({number(row['latency_ticks_p95'], '.0f')})",
            f"{number(found['area'], '.3f')} ({number(found['area_low'], '.2f')} to "
            f"{number(found['area_high'], '.2f')})"
            if found["positives"]
            else "-",
        ]


def _recovery_rows(rows: Sequence[Row]) -> Iterator[list[str]]:
    yield ["", "success", "missions recovered", "harm undone", "added", "worst, recovered"]
    yield ["golden", rate(rows[0]["golden"])]
    for row in rows:
        bare = row["detector"] == NONE
        yield [
            row["detector"],
            rate(row["unprotected"] if bare else row["protected"]),
            "" if bare else _share(row["recovered"]),
            "" if bare else _share(row["undone"]),
            "" if bare else _fraction(row["added"]),
            _worst_cell(row),
        ]


def _group_rows(by: str, rows: Sequence[Row]) -> Iterator[list[str]]:
    """Number of harmful faults that each detector detects, and whose harm it undoes."""
    detectors = [row["detector"] for row in rows if row["value"] == rows[0]["value"]]
    told = [name for name in detectors if name != NONE]
    yield [f"by {by}", "active", "harmful", "seen:", *told, "undone:", *told]
    for value in dict.fromkeys(row["value"] for row in rows):
        group = {row["detector"]: row for row in rows if row["value"] == value}
        first = group[detectors[0]]
        if by == "state" and not first["harmful"]["count"]:
            continue
        yield [
            value,
            f"{first['active']}",
            f"{first['harmful']['count']}",
            "",
            *(f"{group[name]['detected_harmful']['count']}" for name in told),
            "",
            *(f"{group[name]['undone']['count']}" for name in told),
        ]


def _worst_rows(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Worst flight time of each world over the golden flight's, and its recovery."""
    yield ["worst time", *dict.fromkeys(row["detector"] for row in rows)]
    for value in dict.fromkeys(row["value"] for row in rows):
        group = [row for row in rows if row["value"] == value]
        yield [value, *map(_worst_cell, group)]


def _worst_cell(row: Row) -> str:
    worst = row["worst"]
    told = percent(worst["protected"], "+.1f")
    recovered = row["detector"] != NONE and not math.isnan(worst["recovered_share"])
    return told + (f", {percent(worst['recovered_share'], '.0f')}" if recovered else "")


def _comparison_rows(rows: Sequence[Row]) -> Iterator[list[str]]:
    yield ["", "recovers: only it", "the other", "p", "undoes harm: only it", "the other", "p"]
    for row in rows:
        if NONE in (row["first"], row["second"]):
            continue
        told = [
            part
            for test in (row["recovered"], row["undone"])
            for part in (
                f"{test['only_first']}",
                f"{test['only_second']}",
                f"{test['corrected_p']:.2g}",
            )
        ]
        yield [f"{row['first']} against {row['second']}", *told]


def _fraction(share: Row) -> str:
    return f"{share['count']}/{share['total']}" if share["total"] else "-"


def _share(share: Row) -> str:
    return f"{_fraction(share)}: {rate(share, 0)}" if share["total"] else "-"


def detector_csv(*pairs: pa.Table) -> str:
    """One row per pair: first the pairs without faults, then those with one."""
    return csv_text((row for table in pairs for row in table.select([*CSV]).to_pylist()), [*CSV])
