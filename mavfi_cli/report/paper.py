"""Tables that compare our numbers with the paper's, and figures for print."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.core.types import FloatArray
from mavfi_cli.report.drawing import (
    GRID,
    INK,
    NOTE,
    Look,
    legend_above,
    new_figure,
    open_frame,
    scattered,
)
from mavfi_cli.report.table import FORMATS, Table, number, with_ends
from mavfi_cli.stats.bootstrap import TABLE_RESAMPLES, interval
from mavfi_cli.stats.shares import Interval, Share

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Printed = float | str | None  # the paper's number, its words for it, or nothing
DETECTOR_TITLES = {"gad": "Gaussian", "aad": "autoencoder"}


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperCell:
    """One cell of a table: our number with its interval and sample size, and the paper's number.

    Attributes:
        value, low, high: our number and the ends of its interval; NaN if there are none. A maximum
            has no interval.
        count: number of missions, pairs or runs behind our number.
        paper: the paper's number, or its words for it; None if the paper prints nothing.
    """

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan
    count: int = 0
    paper: Printed = None

    @classmethod
    def of_share(cls, share: Share, paper: Printed = None) -> PaperCell:
        """Return the cell for a share, converted to per cent."""
        if not share.total:
            return cls(paper=paper)
        ends = {"value": share.share, "low": share.low, "high": share.high}
        return cls(**{k: 100.0 * v for k, v in ends.items()}, count=share.total, paper=paper)

    @classmethod
    def of_mean(cls, values: Sequence[float] | FloatArray, paper: Printed = None) -> PaperCell:
        """Return the cell for the mean of `values`, with its bootstrap interval."""
        return replace(cls.of_interval(interval(values, resamples=TABLE_RESAMPLES)), paper=paper)

    @classmethod
    def of_interval(cls, mean: Interval, scale: float = 1.0) -> PaperCell:
        """Return the cell for a mean with its interval, both multiplied by `scale`."""
        ends = {"value": mean.value, "low": mean.low, "high": mean.high}
        return cls(**{k: scale * v for k, v in ends.items()}, count=mean.count)


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperColumn:
    """The heading of a column of numbers, and the format of its numbers.

    Attributes:
        title: heading with the unit.
        digits: number of digits after the decimal point.
        ends: the same for the ends of intervals; None means `digits`.
        sign: whether positive numbers have a plus sign.
    """

    title: str
    digits: int = 1
    ends: int | None = None
    sign: bool = False

    def formatted(self, value: float) -> str:
        """Format a number with the digits of the column. NaN and infinity become a dash."""
        return number(value, self._shape(self.digits))

    def ours(self, cell: PaperCell) -> str:
        """Format our number in a cell, with its interval if it has one."""
        ends = self._shape(self.digits if self.ends is None else self.ends)
        return with_ends((cell.value, cell.low, cell.high), self._shape(self.digits), ends)

    def _shape(self, digits: int) -> str:
        return f"{'+' if self.sign else ''}.{digits}f"

    def printed(self, paper: Printed) -> str:
        """Format the paper's number like ours, or return the paper's words, which may be empty."""
        if isinstance(paper, float):
            return self.formatted(paper)
        return paper or ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperRow:
    """One row of a table: its labels, and one cell per column."""

    labels: tuple[str, ...]
    cells: tuple[PaperCell, ...]

    @property
    def count(self) -> str:
        """Sample size of the row's numbers as text, or its range, such as `20 to 25`."""
        counts = sorted({cell.count for cell in self.cells if not math.isnan(cell.value)})
        if len(counts) < 2:
            return str(counts[0]) if counts else "0"
        return f"{counts[0]} to {counts[-1]}"


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTable:
    """A table of the paper, or the numbers behind one of its figures, with our numbers.

    Attributes:
        name: name of the table or figure, such as `table4`.
        title: the paper's name for the table or figure, and what it shows.
        labels: headings of the columns with the rows' labels.
        notes: lines below the table.
        result: what the table shows, in one line.
    """

    name: str
    title: str
    labels: tuple[str, ...]
    columns: tuple[PaperColumn, ...]
    rows: tuple[PaperRow, ...]
    notes: tuple[str, ...] = ()
    result: str = ""

    def printed_in(self, place: int) -> bool:
        """Return True if the paper prints anything in the column with index `place`."""
        return any(row.cells[place].paper is not None for row in self.rows)

    def beside(self, row: PaperRow, place: int, unit: str = " %") -> str:
        """Format our number in column `place` of a row, with the paper's in brackets if it has one.

        Args:
            place: index of the column.
            unit: appended to both numbers.
        """
        column, cell = self.columns[place], row.cells[place]
        paper = column.printed(cell.paper)
        return f"{column.formatted(cell.value)}{unit}" + (
            f" (paper {paper}{unit})" if paper else ""
        )

    def ranked(self, place: int) -> list[PaperRow]:
        """Return the rows with a number in the column with index `place`, largest number first."""
        rows = [row for row in self.rows if not math.isnan(row.cells[place].value)]
        return sorted(rows, key=lambda row: -row.cells[place].value)

    @property
    def table(self) -> Table:
        """The table as text cells: labels, sample size, and our numbers beside the paper's.

        If it is split into pages, our number and the paper's stay on the same page.
        """
        head = [*self.labels, "n"]
        parts = [1 + self.printed_in(place) for place in range(len(self.columns))]
        for column, part in zip(self.columns, parts, strict=True):
            head += [column.title, *["paper"] * (part - 1)]
        rows = [head]
        for row in self.rows:
            cells = [*row.labels, row.count]
            for column, cell, part in zip(self.columns, row.cells, parts, strict=True):
                cells += [column.ours(cell), column.printed(cell.paper)][:part]
            rows.append(cells)
        return Table(
            rows, labels=len(self.labels), kept=1, parts=parts, name=self.name, title=self.title,
            notes=self.notes,
        )  # fmt: skip

    def formatted(self, form: str) -> str:
        """Return the table as text in the format `form`, one of FORMATS; for CSV, see `csv`."""
        return self.csv() if form == "csv" else FORMATS[form](self.table)

    def csv(self) -> str:
        """Return the table as CSV with one line per number, in full precision."""
        return Table.of_records(
            {
                "item": self.name,
                **dict(zip(self.labels, row.labels, strict=True)),
                "quantity": column.title,
                **{name: _plain(getattr(cell, name)) for name in ("value", "low", "high")},
                "n": cell.count,
                "paper": cell.paper,
            }
            for row in self.rows
            for column, cell in zip(self.columns, row.cells, strict=True)
        ).csv()


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else value


# Figures for print --------------------------------------------------------------------------------

WIDTHS_IN = {"one": 3.5, "two": 7.16}  # of one and two columns on an IEEE page
SMALLEST = 7.0  # points
PALETTE = ("#16213e", "#b3402a", "#4f93c8", "#f0b95a")  # dark to light; distinct in greyscale
MARKERS = ("o", "s", "^", "D")
_PAPER: Look = {
    "marker": "D", "markersize": 4.5, "markerfacecolor": "white", "markeredgecolor": INK,
    "markeredgewidth": 0.9, "linestyle": "none",
}  # fmt: skip
# In %. If a value exceeds _OUTLIER, the axis is logarithmic beyond _LINEAR.
_OUTLIER, _LINEAR = 200.0, 20.0
_LINE_IN, _NEXT_LINE_IN = 0.19, 0.11  # height of a row, and of each further line of its name
_NAME = 36  # characters in a line of a row's name


def print_axes(axes: Axes, title: str = "") -> None:
    """Set the frame and the text sizes of a panel for print."""
    axes.tick_params(labelsize=SMALLEST, color=GRID, length=2.5, pad=2)
    open_frame(axes, title, "x", fontsize=SMALLEST + 0.5, loc="left", pad=3)


# A table as dots ---------------------------------------------------------------------------------


def draw_dots(table: PaperTable, columns: str = "one") -> Figure:
    """Draw each column of a table as a panel, with our numbers as dots and the paper's as diamonds.

    Our numbers have their intervals.

    Args:
        table: has at least one row.
        columns: width of the figure in columns of the printed page, `one` or `two`.
    """
    places = [
        place
        for place in range(len(table.columns))
        if any(math.isfinite(row.cells[place].value) for row in table.rows)
    ] or [0]
    whole = (", ".join(label for label in row.labels if label) for row in table.rows)
    names = [textwrap.fill(name, _NAME) for name in whole]
    row_in = _LINE_IN + _NEXT_LINE_IN * max(name.count("\n") for name in names)
    titles = [table.columns[place].title for place in places]
    figure, panels = _panels(titles, names, columns, 0.62 + row_in * max(2, len(names)), 0.25)
    for panel, place in zip(panels, places, strict=True):
        panel.margins(x=0.08)
        for y, row in enumerate(table.rows):
            _dot(panel, y, row.cells[place])
    ours = panels[0].plot(
        [], [], "o-", color=PALETTE[0], markersize=4, linewidth=1.2, label="ours, 95 % interval"
    )
    _explain(figure, ours, "paper" if any(map(table.printed_in, places)) else "", "lower")
    return figure


def _panels(
    titles: Iterable[str],
    names: Sequence[str],
    columns: str,
    panel_in: float,
    more_in: float,
    *,
    sharex: bool = False,
) -> tuple[Figure, list[Axes]]:
    """Return a new figure and its panels, one for each title, which have the same rows.

    Args:
        names: names of the rows, from top to bottom.
        panel_in, more_in: height of a panel, and of the rest of the figure.
    """
    panels = list(titles)
    across = min(len(panels), 4 if columns == "two" else 2)
    down = math.ceil(len(panels) / across)
    figure = new_figure(WIDTHS_IN[columns], down * panel_in + more_in)
    grid = figure.subplots(down, across, squeeze=False, sharey=True, sharex=sharex)
    for axes, title in zip(grid.flat, panels, strict=False):
        print_axes(axes, title)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    grid[0, 0].set_yticks(range(len(names)), names, fontsize=SMALLEST)
    grid[0, 0].set_ylim(len(names) - 0.5, -0.5)
    return figure, list(grid.flat[: len(panels)])


def _dot(axes: Axes, y: int, cell: PaperCell) -> None:
    if isinstance(cell.paper, float):
        axes.plot(cell.paper, y, **_PAPER)
    if math.isfinite(cell.value):
        if math.isfinite(cell.low) and math.isfinite(cell.high):
            axes.hlines(y, cell.low, cell.high, color=PALETTE[0], linewidth=1.2)
        axes.plot(cell.value, y, "o", color=PALETTE[0], markersize=4)


def _explain(figure: Figure, ours: list[Any], paper: str, side: str, **spaces: Any) -> None:
    """Add a legend for our marks and, unless its label `paper` is empty, for the paper's mark."""
    handles = ours + (figure.axes[0].plot([], [], label=paper, **_PAPER) if paper else [])
    look = {"loc": f"outside {side} center", "ncols": 2, "frameon": False, "fontsize": SMALLEST}
    figure.legend(handles=handles, **{**look, **spaces})


# Flights as distributions ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Strip:
    """The flights that one row of a panel shows, as one value per flight.

    Attributes:
        values: one value for each flight, (n,).
        style: index into PALETTE.
        paper: the paper's largest value; None if it prints none.
    """

    label: str
    values: FloatArray
    style: int = 0
    paper: float | None = None


def draw_strips(
    panels: Mapping[str, Sequence[Strip]], quantity: str, columns: str = "one"
) -> Figure:
    """Draw each flight as a dot, with quartiles, median and maximum, and the paper's maximum.

    Args:
        panels: the rows of each panel from top to bottom, by its title; all have the same labels.
        quantity: quantity on the horizontal axis, with its unit.
    """
    names = [strip.label for strip in next(iter(panels.values()))]
    height_in = 0.45 + _LINE_IN * len(names)
    figure, drawn = _panels(panels, names, columns, height_in, 0.45, sharex=True)
    for axes, strips in zip(drawn, panels.values(), strict=True):
        for y, strip in enumerate(strips):
            _strip(axes, y, strip)
    longest = (strip.values.max() for x in panels.values() for strip in x if len(strip.values))
    if max(longest, default=0.0) > _OUTLIER:
        _compress(drawn[0])  # the panels share their horizontal axis
    figure.supxlabel(quantity, fontsize=SMALLEST + 0.5, color=INK)
    printed = any(strip.paper is not None for strips in panels.values() for strip in strips)
    ours = drawn[0].plot([], [], "|", color=INK, markersize=7, label="longest", markeredgewidth=1.4)
    paper = "paper's longest" if printed else ""
    _explain(figure, ours, paper, "upper", columnspacing=1.0, handletextpad=0.3)
    return figure


def _compress(axes: Axes) -> None:
    """Make the horizontal axis logarithmic beyond _LINEAR."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axes.set_xscale("symlog", linthresh=_LINEAR)
    axes.xaxis.set_major_locator(FixedLocator([-100, -_LINEAR, 0, _LINEAR, 100, 1000, 10000]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))


def _strip(axes: Axes, y: int, strip: Strip) -> None:
    values, colour = strip.values, PALETTE[strip.style]
    if strip.paper is not None:
        axes.plot(strip.paper, y, **_PAPER)
    if not len(values):
        axes.text(0.02, y, "no flight", transform=axes.get_yaxis_transform(), va="center",
                  fontsize=SMALLEST, color=NOTE)  # fmt: skip
        return
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    axes.hlines(y, low, high, color=INK, linewidth=1.0)
    axes.vlines(middle, y - 0.3, y + 0.3, color=INK, linewidth=1.0)
    heights = y + 0.56 * scattered(len(values))
    axes.plot(
        values, heights, MARKERS[strip.style], color=colour, markersize=2.6, alpha=0.7,
        markeredgewidth=0.0,
    )  # fmt: skip
    axes.plot(values.max(), y, "|", color=INK, markersize=7, markeredgewidth=1.4)


# Stacked shares ----------------------------------------------------------------------------------

_HATCHES = ("", "////", "....", "")


def draw_stack(table: PaperTable, columns: str = "one") -> Figure:
    """Draw each row of a table as a bar of 100 per cent, divided into the shares in its columns.

    The line across the end of a part is the interval of its share. The last part, which is the
    rest, has none.
    """
    from matplotlib.patheffects import withStroke

    rows = len(table.rows)
    figure = new_figure(WIDTHS_IN[columns], 0.85 + 1.25 * _LINE_IN * rows)
    axes = figure.subplots()
    print_axes(axes)
    left = np.zeros(rows)
    for style, column in enumerate(table.columns):
        cells = [row.cells[style] for row in table.rows]
        shares = np.array([cell.value for cell in cells])
        axes.barh(
            range(rows), shares, left=left, height=0.7, color=PALETTE[style], edgecolor="white",
            linewidth=0.4, hatch=_HATCHES[style], label=column.title.removesuffix(", %"),
        )  # fmt: skip
        left += shares
        for y, cell in enumerate(cells):
            if cell.value > 0.0 and style + 1 < len(table.columns):
                start = left[y] - cell.value
                axes.hlines(
                    y - 0.2 + 0.2 * style, start + cell.low, start + cell.high, color=INK,
                    linewidth=0.9, path_effects=[withStroke(linewidth=2.2, foreground="white")],
                )  # fmt: skip
    axes.set_yticks(range(rows), [row.labels[0] for row in table.rows], fontsize=SMALLEST)
    axes.set_ylim(rows - 0.4, -0.6)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of injected runs, %", fontsize=SMALLEST + 0.5)
    legend_above(figure, fontsize=SMALLEST)
    return figure


# Histograms --------------------------------------------------------------------------------------


def draw_histograms(
    rows: Sequence[tuple[str, FloatArray, FloatArray]], columns: str = "one"
) -> Figure:
    """Draw a histogram of values and one of deltas in each row, both on the same scale.

    Args:
        rows: name of a state, its values (n,), and their deltas (m,).
    """
    from matplotlib.ticker import NullFormatter

    figure = new_figure(WIDTHS_IN[columns], 0.35 + 0.95 * len(rows))
    grid = figure.subplots(len(rows), 2, squeeze=False)
    for (name, *both), panels in zip(rows, grid, strict=True):
        spans = [float(np.abs(part).max()) if len(part) else 1.0 for part in both]
        for kind, values, axes in zip(("value", "delta"), both, panels, strict=True):
            print_axes(axes, f"{name}: {kind}")
            axes.hist(values, bins=61, range=(-max(spans), max(spans)), color=PALETTE[0])
            if len(values):
                axes.set_yscale("log")
                axes.set_ylim(bottom=0.8)
            axes.yaxis.set_minor_formatter(NullFormatter())
    figure.supylabel("control ticks", fontsize=SMALLEST + 0.5)
    return figure
