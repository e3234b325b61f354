"""An evaluation of detectors as text, CSV and pictures; an autoencoder's loss curve."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.detectors import (
    ALL,
    CSV,
    NONE,
    DetectorComparison,
    DetectorCurves,
    ErrorFreeRow,
    Evaluation,
    FaultRow,
)
from mavfi_cli.analysis.pairs import LONGER
from mavfi_cli.report.drawing import (
    NOTE,
    detector_colours,
    legend_above,
    new_figure,
    note_at,
    open_frame,
    whisker,
)
from mavfi_cli.report.table import Table, number, percent, rate, spread, with_ends
from mavfi_cli.stats.shares import Share

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INTERVALS = "in brackets: 95 % intervals (Wilson for shares, bootstrap for the rest)"


def detector_lines(evaluation: Evaluation) -> list[str]:
    """Return the lines that report an evaluation of detectors, as text and tables."""
    lines = _head(evaluation)
    lines += ["", "Without faults, against the same flights without a detector"]
    lines += Table([*_error_free_rows(evaluation.error_free)]).lines()
    faults = _of(evaluation.faults, ALL)
    if not faults or not faults[0].planned:
        return lines
    lines += ["", "Faults: detection, by an alarm at or after the strike"]
    lines += Table([*_detection_rows(faults, evaluation.curves)]).lines()
    lines += ["", "Faults: recovery"]
    lines += Table([*_recovery_rows(faults)]).lines()
    lines += ["", *Table([*_worst_rows(_of(evaluation.faults, "world"))]).lines()]
    for by in ("world", "stage", "field", "state"):
        rows = Table([*_group_rows(by, _of(evaluation.faults, by))]).lines()
        lines += ["", *rows] if len(rows) > 1 else []
    lines += ["", *Table([*_comparison_rows(evaluation.comparisons)]).lines()]
    return [*lines, _INTERVALS]


def _of(faults: Sequence[FaultRow], by: str) -> list[FaultRow]:
    return [row for row in faults if row.by == by]


def _head(evaluation: Evaluation) -> list[str]:
    plan = evaluation.plan
    faults = _of(evaluation.faults, ALL)
    lines = [
        f"Flights     {', '.join(plan.worlds)}: {plan.golden_flights} error-free missions "
        f"each, {plan.flights} of them with",
        f"            a fault at each of {len(plan.places)} kinds of places; {plan.level} "
        f"level, from seed {plan.first_seed} on",
        f"Detectors   {', '.join([NONE, *plan.detectors])}, on {', '.join(plan.protect)}",
    ]
    if faults:
        row = faults[0]
        lines += [
            f"Faults      {row.planned}: {row.not_injected} not injected, "
            f"{row.not_activated} not activated, {row.active} active",
            f"            {row.harmful.count} harmful: {row.lost} lost the mission, "
            f"{row.longer} took over {100 * (LONGER - 1):.0f} % longer",
        ]
        if row.golden_failed:
            lines.append(f"            {row.golden_failed} of missions that fail without the fault")
        if row.crashed:
            lines.append(f"            {row.crashed} of the active ones killed a node")
    if evaluation.errors:
        lines.append(f"            {len(evaluation.errors)} missions could not be flown")
    return lines


def _error_free_rows(rows: Sequence[ErrorFreeRow]) -> Iterator[list[str]]:
    yield ["", "flights", "alarms an hour", "with an alarm", "missions lost", "longer (median), %"]
    for row in rows:
        if row.by != ALL or row.detector == NONE:
            continue
        yield [
            row.detector,
            f"{row.flights}",
            spread(row.alarms_per_hour, 1),
            _share(row.with_alarm),
            _fraction(row.lost) + (f", {row.gained} won" if row.gained else ""),
            spread(row.lengthening, 2, 100.0),
        ]


def _detection_rows(
    rows: Sequence[FaultRow], curves: Mapping[str, DetectorCurves]
) -> Iterator[list[str]]:
    yield ["", "harmful", "all active", "by chance", "ticks (95th)", "ROC area"]
    for row in rows:
        if row.detector == NONE:
            continue
        curve = curves[row.detector]
        yield [
            row.detector,
            _share(row.detected_harmful),
            rate(row.detected_active),
            percent(row.by_chance.share),
            f"{number(row.latency_ticks, '.0f')} ({number(row.latency_ticks_p95, '.0f')})",
            f"{number(curve.area, '.3f')} ({number(curve.area_low, '.2f')} to "
            f"{number(curve.area_high, '.2f')})"
            if curve.positives
            else "-",
        ]


def _recovery_rows(rows: Sequence[FaultRow]) -> Iterator[list[str]]:
    yield ["", "success", "missions recovered", "harm undone", "added", "worst, recovered"]
    for row in rows:
        bare = row.detector == NONE
        mixed = (row.protected["share"], row.protected["low"], row.protected["high"])
        yield [
            row.detector,
            rate(row.unprotected)
            if bare
            else with_ends(mixed, ".1f", ".0f", scale=100.0, unit=" %"),
            "" if bare else _share(row.recovered),
            "" if bare else _share(row.undone),
            "" if bare else _fraction(row.added),
            _worst_cell(row),
        ]


def _group_rows(by: str, rows: Sequence[FaultRow]) -> Iterator[list[str]]:
    detectors = [row.detector for row in rows if row.value == rows[0].value]
    watching = [name for name in detectors if name != NONE]
    yield [f"by {by}", "active", "harmful", "seen:", *watching, "undone:", *watching]
    for value in dict.fromkeys(row.value for row in rows):
        group = {row.detector: row for row in rows if row.value == value}
        first = group[detectors[0]]
        if by == "state" and not first.harmful.count:
            continue
        yield [
            value,
            f"{first.active}",
            f"{first.harmful.count}",
            "",
            *(f"{group[name].detected_harmful.count}" for name in watching),
            "",
            *(f"{group[name].undone.count}" for name in watching),
        ]


def _worst_rows(rows: Sequence[FaultRow]) -> Iterator[list[str]]:
    yield ["worst time", *dict.fromkeys(row.detector for row in rows)]
    for value in dict.fromkeys(row.value for row in rows):
        group = [row for row in rows if row.value == value]
        yield [value, *map(_worst_cell, group)]


def _worst_cell(row: FaultRow) -> str:
    worst = row.worst
    longest = percent(worst.protected, "+.1f")
    recovered = row.detector != NONE and not math.isnan(worst.recovered_share)
    return longest + (f", {percent(worst.recovered_share, '.0f')}" if recovered else "")


def _comparison_rows(rows: Sequence[DetectorComparison]) -> Iterator[list[str]]:
    yield ["", "recovers: only it", "the other", "p", "undoes harm: only it", "the other", "p"]
    for row in rows:
        if NONE in (row.first, row.second):
            continue
        tests = (
            (f"{test.only_first}", f"{test.only_second}", f"{test.corrected_p:.2g}")
            for test in (row.recovered, row.undone)
        )
        yield [f"{row.first} against {row.second}", *chain(*tests)]


def _fraction(share: Share) -> str:
    return f"{share.count}/{share.total}" if share.total else "-"


def _share(share: Share) -> str:
    return f"{_fraction(share)}: {rate(share, 0)}" if share.total else "-"


def detector_csv(*pairs: pa.Table) -> str:
    """Return the pairs of flights in one or more tables as CSV, with one row per pair."""
    rows = (row for table in pairs for row in table.select([*CSV]).to_pylist())
    return Table.of_records(rows, [*CSV]).csv()


# Pictures -----------------------------------------------------------------------------------------


def _draw_roc(evaluation: Evaluation) -> Figure:
    """Draw ROC curves on the left, and precision against recall on the right.

    A dot marks each detector at its own threshold.
    """
    figure = new_figure(8.4, 4.4)
    roc, precision = figure.subplots(1, 2)
    colours = detector_colours(list(evaluation.curves))
    drawn = [(name, c) for name, c in evaluation.curves.items() if c.thresholds]
    for name, curve in drawn:
        colour = colours[name]
        label = f"{name}: area {curve.area:.3f}, precision {curve.average_precision:.3f}"
        x, y = [*curve.false_positive_rate, 1.0], [*curve.recall, 1.0]
        roc.plot(x, y, color=colour, linewidth=1.5, label=label)
        roc.plot(*curve.operating_point, "o", color=colour, markersize=5)
        precision.step(curve.recall, curve.precision, where="pre", color=colour, linewidth=1.5)
        precision.plot(*_at_threshold(curve), "o", color=colour, markersize=5)
    roc.plot([0, 1], [0, 1], color=NOTE, linewidth=0.8, linestyle=":")
    _square(roc, "share of error-free flights with an alarm", "share of harmful faults detected")
    _square(precision, "share of harmful faults detected", "share of alarms that are right")
    if drawn:
        counts = drawn[0][1]
        caption = (
            f"{counts.positives} harmful faults against {counts.negatives} error-free "
            "flights; score of a flight: its highest; dots: own threshold"
        )
        legend_above(figure, ncols=2)
    else:
        caption = "no harmful fault: no curve"
    figure.supxlabel(caption, fontsize=7.5, color=NOTE)
    return figure


def _at_threshold(curve: DetectorCurves) -> tuple[float, float]:
    """Return recall and precision at the detector's own threshold.

    The precision is 1 if there are no alarms.
    """
    fallout, recall = curve.operating_point
    hits, false = recall * curve.positives, fallout * curve.negatives
    return recall, hits / (hits + false) if hits + false else 1.0


def _square(axes: Axes, x: str, y: str) -> None:
    axes.set_xlim(-0.02, 1.02)
    axes.set_ylim(-0.02, 1.02)
    axes.set_aspect("equal")
    axes.set_xlabel(x, fontsize=8.5)
    axes.set_ylabel(y, fontsize=8.5)
    axes.tick_params(labelsize=8)
    open_frame(axes, grid="both")


def _draw_recovery(evaluation: Evaluation) -> Figure:
    """Draw how often each detector undoes harm, by stage, and the worst flight times, by world."""
    rows = evaluation.faults
    names = list(dict.fromkeys(row.detector for row in rows))
    colours = detector_colours(names)
    figure = new_figure(9.6, 4.2)
    shares, times = figure.subplots(1, 2)
    stages = [row for row in rows if row.by in ("all", "stage") and row.detector != "none"]
    _bars(
        shares, stages, [name for name in names if name != "none"], colours,
        lambda row: (row.undone.share, row.undone.low, row.undone.high),
        lambda row: row.undone.total,
    )  # fmt: skip
    shares.set_ylim(0.0, 105.0)
    shares.set_ylabel("harmful faults whose harm is undone, %", fontsize=8.5)
    _bars(
        times, [row for row in rows if row.by == "world"], names, colours,
        lambda row: (row.worst.protected, math.nan, math.nan),
        lambda row: row.active,
    )  # fmt: skip
    times.set_ylabel("worst flight time over the golden flight's, %", fontsize=8.5)
    handles = [shares.bar(0, 0, color=colours[name], label=name) for name in names]
    legend_above(figure, handles=handles, ncols=len(names), fontsize=8.5)
    figure.supxlabel(
        "left: whiskers are 95 % Wilson intervals, n harmful faults; right: successful flights "
        "with n active faults", fontsize=7.5, color=NOTE,
    )  # fmt: skip
    return figure


def _bars(
    axes: Axes,
    rows: Sequence[FaultRow],
    names: Sequence[str],
    colours: Mapping[str, str],
    measure: Any,
    count: Any,
) -> None:
    """Draw bars in per cent, with a group per `value` of the rows, and a bar per detector.

    Args:
        names: Detectors, in the order of the bars in a group.
        measure: Function from a row to its value and interval; NaN if there is none.
        count: Function from a row to its number of cases; a row without cases has no bar.
    """
    values = list(dict.fromkeys(row.value for row in rows))
    width = 0.8 / max(1, len(names))
    ticks = {}
    for row in rows:
        ticks[row.value] = f"{row.value}\nn = {count(row)}"
        place = values.index(row.value) + width * (names.index(row.detector) - (len(names) - 1) / 2)
        value, low, high = measure(row)
        if not np.isfinite(value):
            if count(row):
                absent = {"va": "bottom", "fontsize": 7, "color": NOTE, "rotation": 90.0}
                note_at(axes, "no success", (place, 0.0), 2, **absent)
            continue
        axes.bar(place, 100.0 * value, width=0.9 * width, color=colours[row.detector])
        ends = (100.0 * low, 100.0 * high)
        whisker(axes, place, 100.0 * value, ends, elinewidth=0.9, capsize=2.0)
    axes.set_xticks(range(len(values)), [ticks[value] for value in values], fontsize=8)
    axes.set_xlim(-0.6, max(0.6, len(values) - 0.4))
    axes.tick_params(labelsize=8)
    open_frame(axes, grid="y")


def draw_loss_curve(curve: Sequence[Sequence[float]]) -> Figure:
    """Draw an autoencoder's loss over the epochs, on a logarithmic scale.

    The loss is the mean squared error of scaled deltas.

    Args:
        curve: Rows of epoch, mean training error and largest validation error.
    """
    figure = new_figure(5.2, 3.2)
    axes = figure.add_subplot()
    epochs, training, validation = zip(*curve, strict=True)
    axes.plot(epochs, training, color="#1b4965", linewidth=1.4, label="training, mean")
    axes.plot(epochs, validation, color="#e4572e", linewidth=1.4, label="validation, largest")
    axes.set_yscale("log")
    axes.set_xlabel("epoch")
    axes.set_ylabel("mean squared error of scaled deltas")
    axes.grid(visible=True, color="#edf0f4", linewidth=0.6)
    axes.legend(frameon=False, fontsize=8)
    return figure


PICTURES: Mapping[str, Callable[[Evaluation], Figure]] = {
    "roc.svg": _draw_roc,
    "recovery.svg": _draw_recovery,
}
