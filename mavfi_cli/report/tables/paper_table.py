"""A small table in the paper's form: our numbers with n and interval, the paper's beside them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

from mavfi_cli.report.tables.columns import WIDTH, blocks, csv_text
from mavfi_cli.stats.shares import Share

Printed = float | str | None  # a number of the paper, its words for it, or nothing
DETECTOR_TITLES = {"gad": "Gaussian", "aad": "autoencoder"}


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperCell:
    """A number of ours with its interval and count, and the paper's.

    Attributes:
        value, low, high: NaN if there are none; a maximum has no interval.
        count: missions, pairs or runs that it is from.
        paper: None if the paper prints nothing.
    """

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan
    count: int = 0
    paper: Printed = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperColumn:
    """A column of numbers.

    Attributes:
        title: with the unit.
        digits: behind the point.
        ends: digits of the interval's ends; None means as many.
        sign: whether positive numbers have a plus.
    """

    title: str
    digits: int = 1
    ends: int | None = None
    sign: bool = False

    def told(self, value: float, digits: int | None = None) -> str:
        """A number in the column's form; a dash if there is none."""
        shape = f"{'+' if self.sign else ''}.{self.digits if digits is None else digits}f"
        return f"{value:{shape}}" if math.isfinite(value) else "-"

    def printed(self, paper: Printed) -> str:
        """A number of the paper in its own form."""
        if isinstance(paper, float):
            return self.told(paper)
        return paper or ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperRow:
    """One row: its labels, and a number for each column."""

    labels: tuple[str, ...]
    cells: tuple[PaperCell, ...]

    @property
    def count(self) -> str:
        """What the row's numbers are from: one count, or the smallest and the largest."""
        counts = sorted({cell.count for cell in self.cells if not math.isnan(cell.value)})
        if len(counts) < 2:
            return str(counts[0]) if counts else "0"
        return f"{counts[0]} to {counts[-1]}"


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTable:
    """A table of the paper, or the numbers of one of its figures.

    Attributes:
        name: of the item, such as `table4`.
        title: the paper's name of it, and what it shows.
        labels: headings of the rows' labels.
        notes: a line each.
        result: the item's result in one line.
    """

    name: str
    title: str
    labels: tuple[str, ...]
    columns: tuple[PaperColumn, ...]
    rows: tuple[PaperRow, ...]
    notes: tuple[str, ...] = ()
    result: str = ""

    def printed_in(self, place: int) -> bool:
        """Whether the paper prints anything in a column."""
        return any(row.cells[place].paper is not None for row in self.rows)

    def told(self, row: PaperRow, place: int, unit: str = " %") -> str:
        """Our number in a row and a column, with the paper's in brackets if it prints one."""
        column, cell = self.columns[place], row.cells[place]
        paper = column.printed(cell.paper)
        return f"{column.told(cell.value)}{unit}" + (f" (paper {paper}{unit})" if paper else "")

    def ranked(self, place: int) -> list[PaperRow]:
        """The rows with a number in a column, the largest first."""
        rows = [row for row in self.rows if not math.isnan(row.cells[place].value)]
        return sorted(rows, key=lambda row: -row.cells[place].value)


def _ours(column: PaperColumn, cell: PaperCell) -> str:
    value = column.told(cell.value)
    if math.isnan(cell.low) or math.isnan(cell.high):
        return value
    low, high = (column.told(end, column.ends) for end in (cell.low, cell.high))
    return f"{value} ({low} to {high})"


def cells_of(table: PaperTable) -> list[list[str]]:
    """The table as cells of text, headings first: labels, n, then ours and the paper's."""
    head = [*table.labels, "n"]
    for place, column in enumerate(table.columns):
        head += [column.title, *(["paper"] if table.printed_in(place) else [])]
    rows = [head]
    for row in table.rows:
        cells = [*row.labels, row.count]
        for place, (column, cell) in enumerate(zip(table.columns, row.cells, strict=True)):
            cells.append(_ours(column, cell))
            if table.printed_in(place):
                cells.append(column.printed(cell.paper))
        rows.append(cells)
    return rows


def as_text(table: PaperTable) -> str:
    """Aligned columns; those beyond the width continue below."""
    lines = [table.title, *_in_pairs(table), *table.notes]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _in_pairs(table: PaperTable) -> list[str]:
    """The aligned table, in which the paper's number is never cut off from ours."""
    rows = cells_of(table)
    labels = len(table.labels)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    together = [1, *(1 + table.printed_in(place) for place in range(len(table.columns)))]
    joined = []
    for row in rows:
        numbers = map(str.rjust, row[labels:], widths[labels:])
        joined.append([*row[:labels], *("  ".join(islice(numbers, each)) for each in together)])
    return blocks(joined, labels + 1, WIDTH)


def _as_markdown(table: PaperTable) -> str:
    """A pipe table."""
    head, *rows = cells_of(table)
    aligned = ["---"] * len(table.labels) + ["---:"] * (len(head) - len(table.labels))
    lines = [_piped(row) for row in (head, aligned, *rows)]
    return "\n".join([f"**{table.title}**", "", *lines, "", *table.notes]).rstrip() + "\n"


def _piped(row: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in row) + " |"


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}",
}  # fmt: skip


# Sizes of 8 and of 7 points: a character and the gap between two columns of a table are so wide, in
# points, and so are a column of a printed page and the page.
_SIZES = ((r"\footnotesize", 4.4, 6.0), (r"\scriptsize", 3.9, 6.0), (r"\scriptsize", 3.9, 4.0))
_PLACES = (("table", 252.0), ("table*", 516.0))


def _as_latex(table: PaperTable) -> str:
    """A float with a plain tabular, which needs no package.

    It is as wide as a column of two, or as the page, in the largest size that fits.
    """
    head, *rows = cells_of(table)
    form = "l" * len(table.labels) + "r" * (len(head) - len(table.labels))
    place, size, gap_pt = _latex_place([head, *rows])
    lines = [
        rf"\begin{{{place}}}",
        rf"\caption{{{_latex(table.title)}}}",
        rf"\label{{tab:{table.name}}}",
        rf"\centering{size}\setlength{{\tabcolsep}}{{{gap_pt / 2:g}pt}}",
        rf"\begin{{tabular}}{{{form}}}",
        r"\hline",
        _latex_row(head),
        r"\hline",
        *map(_latex_row, rows),
        r"\hline",
        r"\end{tabular}",
        *(rf"\par {_latex(note)}" for note in table.notes),
        rf"\end{{{place}}}",
    ]
    return "\n".join(lines) + "\n"


def _latex_place(rows: Sequence[Sequence[str]]) -> tuple[str, str, float]:
    """The narrowest float and the largest size that hold the table, and the gap; else the last."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for place, width_pt in _PLACES:
        for size, character_pt, gap_pt in _SIZES:
            if sum(widths) * character_pt + len(widths) * gap_pt <= width_pt:
                return place, size, gap_pt
    return place, size, gap_pt


def _latex_row(row: Sequence[str]) -> str:
    return " & ".join(map(_latex, row)) + r" \\"


def _latex(text: str) -> str:
    return "".join(_LATEX.get(each, each) for each in text)


def as_csv(table: PaperTable) -> str:
    """One number a line, in full precision."""
    return csv_text(_long(table))


def _long(table: PaperTable) -> Iterator[Mapping[str, object]]:
    for row in table.rows:
        for column, cell in zip(table.columns, row.cells, strict=True):
            yield {
                "item": table.name,
                **dict(zip(table.labels, row.labels, strict=True)),
                "quantity": column.title,
                **{name: _plain(getattr(cell, name)) for name in ("value", "low", "high")},
                "n": cell.count,
                "paper": "" if cell.paper is None else cell.paper,
            }


def count_of(share: Share) -> str:
    """The counts of a share, such as `3 of 98`."""
    return f"{share.count:,} of {share.total:,}"


def _plain(value: float) -> object:
    return "" if math.isnan(value) else value


FORMATS: Mapping[str, Callable[[PaperTable], str]] = {
    "text": as_text,
    "markdown": _as_markdown,
    "latex": _as_latex,
    "csv": as_csv,
}
