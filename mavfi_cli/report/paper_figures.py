"""Figures for print: column widths, a palette that survives grey, distributions and dots.

Every text is at least SMALLEST points at the size of print. The colours of PALETTE differ in
lightness, so they stay apart without colour; markers and hatches differ as well.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mavfi_cli.core.types import FloatArray
from mavfi_cli.report.drawing import GRID, INK, NOTE, new_figure, open_frame
from mavfi_cli.report.tables.paper_table import PaperTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTHS_IN = {"one": 3.5, "two": 7.16}  # columns of an IEEE page
SMALLEST = 7.0  # points
PALETTE = ("#16213e", "#b3402a", "#4f93c8", "#f0b95a")  # dark to light; no two alike in grey
MARKERS = ("o", "s", "^", "D")
_PAPER = {"marker": "D", "markersize": 4.5, "markerfacecolor": "white", "markeredgecolor": INK,
          "markeredgewidth": 0.9, "linestyle": "none"}  # fmt: skip
_TURN = 0.6180339887498949  # golden ratio; spreads dots evenly and deterministically
_LINE_IN, _NEXT_LINE_IN = 0.19, 0.11  # height of a row, and of a further line of its name
_NAME = 36  # characters in a line of a row's name


def print_figure(columns: str, height_in: float) -> Figure:
    """An empty figure as wide as one or two columns of a page."""
    return new_figure(WIDTHS_IN[columns], height_in)


def print_axes(axes: Axes, title: str = "") -> None:
    """The frame and the text sizes of a panel in print."""
    axes.tick_params(labelsize=SMALLEST, color=GRID, length=2.5, pad=2)
    axes.grid(visible=True, axis="x", color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    open_frame(axes)
    if title:
        axes.set_title(title, fontsize=SMALLEST + 0.5, loc="left", color=INK, pad=3)


# A table as dots ---------------------------------------------------------------------------------


def draw_dots(table: PaperTable, columns: str = "one") -> Figure:
    """A panel for each column of a table: ours with its interval, the paper's as a diamond.

    Args:
        table: at least one row.
    """
    shown = [
        place
        for place in range(len(table.columns))
        if any(math.isfinite(row.cells[place].value) for row in table.rows)
    ] or [0]
    across = min(len(shown), 4 if columns == "two" else 2)
    down = math.ceil(len(shown) / across)
    whole = (", ".join(label for label in row.labels if label) for row in table.rows)
    names = [textwrap.fill(name, _NAME) for name in whole]
    row_in = _LINE_IN + _NEXT_LINE_IN * max(name.count("\n") for name in names)
    height = down * (0.62 + row_in * max(2, len(table.rows)))
    figure = print_figure(columns, height + 0.25)
    grid = figure.subplots(down, across, squeeze=False, sharey=True)
    for panel, place in zip(grid.flat, shown, strict=False):
        _dots(panel, table, place)
    for panel in grid.flat[len(shown) :]:
        panel.set_visible(False)
    grid[0, 0].set_yticks(range(len(table.rows)), names, fontsize=SMALLEST)
    grid[0, 0].set_ylim(len(table.rows) - 0.5, -0.5)
    _explain(figure, any(table.printed_in(place) for place in shown))
    return figure


def _dots(axes: Axes, table: PaperTable, place: int) -> None:
    print_axes(axes, table.columns[place].title)
    axes.margins(x=0.08)
    for y, row in enumerate(table.rows):
        cell = row.cells[place]
        if isinstance(cell.paper, float):
            axes.plot(cell.paper, y, **_PAPER)  # type: ignore[arg-type]
        if not math.isfinite(cell.value):
            continue
        if math.isfinite(cell.low) and math.isfinite(cell.high):
            axes.hlines(y, cell.low, cell.high, color=PALETTE[0], linewidth=1.2)
        axes.plot(cell.value, y, "o", color=PALETTE[0], markersize=4)


def _explain(figure: Figure, paper: bool) -> None:
    axes = figure.axes[0]
    handles = [axes.plot([], [], "o-", color=PALETTE[0], markersize=4, linewidth=1.2,
                         label="ours, 95 % interval")[0]]  # fmt: skip
    if paper:
        handles += axes.plot([], [], label="paper", **_PAPER)  # type: ignore[arg-type]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=SMALLEST
    )


# Flights as distributions ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """The flights of one row of a panel.

    Attributes:
        values: one for each flight, (n,).
        style: place in PALETTE.
        paper: the paper's largest value; None if it prints none.
    """

    label: str
    values: FloatArray
    style: int = 0
    paper: float | None = None


def draw_strips(
    panels: Mapping[str, Sequence[Strip]], quantity: str, columns: str = "one"
) -> Figure:
    """Each flight as a dot, the middle half of them as a bar, the median, and the paper's largest.

    Args:
        panels: the rows of each panel from top to bottom, by its title; all have the same labels.
        quantity: of the horizontal axis, with its unit.
    """
    across = min(len(panels), 4 if columns == "two" else 2)
    down = math.ceil(len(panels) / across)
    rows = max(map(len, panels.values()))
    figure = print_figure(columns, down * (0.45 + _LINE_IN * rows) + 0.45)
    grid = figure.subplots(down, across, squeeze=False, sharey=True, sharex=True)
    for axes, (title, strips) in zip(grid.flat, panels.items(), strict=False):
        print_axes(axes, title)
        for y, strip in enumerate(strips):
            _strip(axes, y, strip)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    labels = [strip.label for strip in next(iter(panels.values()))]
    grid[0, 0].set_yticks(range(rows), labels, fontsize=SMALLEST)
    grid[0, 0].set_ylim(rows - 0.5, -0.5)
    figure.supxlabel(quantity, fontsize=SMALLEST + 0.5, color=INK)
    printed = any(strip.paper is not None for strips in panels.values() for strip in strips)
    _explain_strips(figure, printed)
    return figure


def _strip(axes: Axes, y: int, strip: Strip) -> None:
    values, colour = strip.values, PALETTE[strip.style]
    if strip.paper is not None:
        axes.plot(strip.paper, y, **_PAPER)  # type: ignore[arg-type]
    if not len(values):
        axes.text(0.02, y, "no flight", transform=axes.get_yaxis_transform(), va="center",
                  fontsize=SMALLEST, color=NOTE)  # fmt: skip
        return
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    axes.hlines(y, low, high, color=INK, linewidth=1.0)
    axes.vlines(middle, y - 0.3, y + 0.3, color=INK, linewidth=1.0)
    heights = y + 0.56 * ((0.5 + np.arange(len(values)) * _TURN) % 1.0 - 0.5)
    axes.plot(
        values, heights, MARKERS[strip.style], color=colour, markersize=2.6, alpha=0.7,
        markeredgewidth=0.0,
    )  # fmt: skip
    axes.plot(values.max(), y, "|", color=INK, markersize=7, markeredgewidth=1.4)


def _explain_strips(figure: Figure, paper: bool) -> None:
    axes = figure.axes[0]
    handles = axes.plot([], [], "|", color=INK, markersize=7, label="longest", markeredgewidth=1.4)
    if paper:
        handles += axes.plot([], [], label="paper's longest", **_PAPER)  # type: ignore[arg-type]
    figure.legend(
        handles=handles, loc="outside upper center", ncols=min(len(handles), 3), frameon=False,
        fontsize=SMALLEST, columnspacing=1.0, handletextpad=0.3,
    )  # fmt: skip


# Stacked shares ----------------------------------------------------------------------------------

_HATCHES = ("", "////", "....", "")


def draw_stack(table: PaperTable, columns: str = "one") -> Figure:
    """A bar of a hundred per cent for each row, cut into the table's columns."""
    rows = len(table.rows)
    figure = print_figure(columns, 0.85 + 1.25 * _LINE_IN * rows)
    axes = figure.subplots()
    print_axes(axes)
    left = np.zeros(rows)
    for style, column in enumerate(table.columns):
        shares = np.array([row.cells[style].value for row in table.rows])
        axes.barh(
            range(rows), shares, left=left, height=0.7, color=PALETTE[style], edgecolor="white",
            linewidth=0.4, hatch=_HATCHES[style], label=column.title.removesuffix(", %"),
        )  # fmt: skip
        left += shares
    axes.set_yticks(range(rows), [row.labels[0] for row in table.rows], fontsize=SMALLEST)
    axes.set_ylim(rows - 0.4, -0.6)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of injected runs, %", fontsize=SMALLEST + 0.5)
    figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize=SMALLEST)
    return figure


# Histograms --------------------------------------------------------------------------------------


def draw_histograms(
    rows: Sequence[tuple[str, FloatArray, FloatArray]], columns: str = "one"
) -> Figure:
    """Two histograms for each row on one scale: values, and their deltas."""
    from matplotlib.ticker import NullFormatter

    figure = print_figure(columns, 0.35 + 0.95 * len(rows))
    grid = figure.subplots(len(rows), 2, squeeze=False)
    for (name, *both), panels in zip(rows, grid, strict=True):
        spans = [float(np.abs(each).max()) if len(each) else 1.0 for each in both]
        for kind, values, axes in zip(("value", "delta"), both, panels, strict=True):
            print_axes(axes, f"{name}: {kind}")
            axes.hist(values, bins=61, range=(-max(spans), max(spans)), color=PALETTE[0])
            if len(values):
                axes.set_yscale("log")
                axes.set_ylim(bottom=0.8)
            axes.yaxis.set_minor_formatter(NullFormatter())
    figure.supylabel("control ticks", fontsize=SMALLEST + 0.5)
    return figure
