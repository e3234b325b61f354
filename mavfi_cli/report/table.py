"""A table as text, Markdown, LaTeX, CSV or HTML, and formats for the numbers in its cells.

Text does not use rich, which folds or truncates the cells of a table that is too wide. Here, excess
columns follow in another table that repeats the labels, so a file can be searched line by line.
"""

from __future__ import annotations

import csv
import html
import io
import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from mavfi_cli.core.errors import printable
from mavfi_cli.stats.shares import Interval, Share

WIDTH = 100  # characters; default maximum width of a table
_GAP = 2
_LEAST_ROOM = 20  # characters; minimum width of the prose column


@dataclass(frozen=True, slots=True)
class Table:
    """A table of formatted cells, which can be written in each of FORMATS.

    Attributes:
        rows: the headings, if there are any, come first. Rows may differ in length; missing cells
            are empty.
        labels: number of left-aligned columns at the start; the other columns are right-aligned.
            None aligns all columns left.
        kept: number of columns after the labels that are repeated, like the labels, on every page
            of a wide table.
        parts: sizes of the groups of remaining columns that stay together on one page; empty if
            every column is a group of its own.
        prose: whether the last column is wrapped at the width of the table.
        name: label of a LaTeX table.
        title: caption.
        notes: lines below the table.
    """

    rows: Sequence[Sequence[str]]
    labels: int | None = None
    kept: int = 0
    parts: Sequence[int] = ()
    prose: bool = False
    name: str = ""
    title: str = ""
    notes: Sequence[str] = ()

    @classmethod
    def of_records(cls, records: Iterable[Mapping[str, Any]], names: Sequence[str] = ()) -> Self:
        """Return a table with the column names as headings, and one row per record.

        Numbers are not rounded. A cell is empty if its record has no value.

        Args:
            names: names of the columns; if empty, the keys of all records, in order.
        """
        rows = list(records)
        keys = names or list(dict.fromkeys(key for row in rows for key in row))
        cells = ([_text(row.get(key)) for key in keys] for row in rows)
        return cls([[*keys], *cells])

    def lines(self, width: int | None = None) -> list[str]:
        """Return one aligned line per row, with two spaces between the cells.

        Args:
            width: in characters. Columns beyond it continue in further tables below an empty line;
                each repeats the labels and has at least one other column. None sets no limit.
        """
        cells = self._wrapped(width or WIDTH) if self.prose else self._padded()
        if width is None or self.labels is None:
            return _aligned(cells, self.labels)
        lines: list[str] = []
        own = self.labels + self.kept
        for first, end in self._pages(_widths(cells), own, width):
            page = [row[:own] + row[first:end] for row in cells]
            lines += ([""] if lines else []) + _aligned(page, self.labels)
        return lines

    def text(self) -> str:
        """Return the table as plain text: title, aligned columns and notes."""
        lines = [*([self.title] if self.title else []), *self.lines(WIDTH), *self.notes]
        return "\n".join(map(printable, lines)) + "\n"

    def markdown(self) -> str:
        """Return the table in Markdown: the title in bold, rows with pipes, and the notes."""
        head, *rows = self._padded()
        rules = ["---" if left else "---:" for left in self._left(len(head))]
        lines = [
            "| " + " | ".join(cell.replace("|", r"\|") for cell in row) + " |"
            for row in (head, rules, *rows)
        ]
        title = [f"**{self.title}**", ""] if self.title else []
        return "\n".join(map(printable, [*title, *lines, "", *self.notes])).rstrip() + "\n"

    def latex(self) -> str:
        """Return the table as a LaTeX float with a plain tabular, which needs no package.

        It is as wide as one column of a two-column page, or as the whole page, in the largest font
        size that fits.
        """
        head, *rows = self._padded()
        form = "".join("l" if left else "r" for left in self._left(len(head)))
        place, size, gap_pt = _latex_place(_widths([head, *rows]))
        lines = [
            rf"\begin{{{place}}}",
            rf"\caption{{{_latex(self.title)}}}",
            rf"\label{{tab:{self.name}}}",
            rf"\centering{size}\setlength{{\tabcolsep}}{{{gap_pt / 2:g}pt}}",
            rf"\begin{{tabular}}{{{form}}}",
            r"\hline",
            _latex_row(head),
            r"\hline",
            *map(_latex_row, rows),
            r"\hline",
            r"\end{tabular}",
            *(rf"\par {_latex(note)}" for note in self.notes),
            rf"\end{{{place}}}",
        ]
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Return the table as CSV with one line per row, without title and notes."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(self._padded())
        return text.getvalue()

    def html(self, *, bare: bool = False) -> str:
        """Return the table as an HTML element with escaped cells, followed by the notes.

        Right-aligned cells have the class `n`.

        Args:
            bare: leave out title and notes.
        """
        head, *rows = self._padded()
        left = self._left(len(head))

        def line(tag: str, cells: Sequence[str]) -> str:
            begins = (f"<{tag}>" if label else f'<{tag} class="n">' for label in left)
            marked = map("{}{}</{}>".format, begins, map(html.escape, cells), [tag] * len(left))
            return f"<tr>{''.join(marked)}</tr>"

        caption = [f"<caption>{html.escape(self.title)}</caption>"] if self.title else []
        notes = [f'<p class="note">{html.escape(note)}</p>' for note in self.notes]
        lines = [
            "<table>", *([] if bare else caption), f"<thead>{line('th', head)}</thead>", "<tbody>",
            *(line("td", row) for row in rows), "</tbody>", "</table>", *([] if bare else notes),
        ]  # fmt: skip
        return "\n".join(lines) + "\n"

    def _padded(self) -> list[list[str]]:
        count = max(map(len, self.rows), default=0)
        return [[*row, *[""] * (count - len(row))] for row in self.rows]

    def _left(self, columns: int) -> list[bool]:
        return [self.labels is None or place < self.labels for place in range(columns)]

    def _wrapped(self, width: int) -> list[list[str]]:
        """Return the rows of cells with the last column wrapped, so that the table fits the width.

        The continuation of a wrapped cell is an additional row, whose other cells are empty.
        """
        cells = self._padded()
        room = width - sum(column + _GAP for column in _widths(cells)[:-1])
        rows = []
        for *row, prose in cells:
            first, *rest = textwrap.wrap(prose, max(room, _LEAST_ROOM)) or [""]
            rows += [[*row, first], *([""] * len(row) + [line] for line in rest)]
        return rows

    def _pages(self, widths: Sequence[int], kept: int, width: int) -> Iterator[tuple[int, int]]:
        """Yield the index of the first column of each page, and the index after its last column."""
        own = sum(column + _GAP for column in widths[:kept])
        first, end, used = kept, kept, own
        for columns in self.parts or [1] * (len(widths) - kept):
            needed = sum(widths[end : end + columns]) + _GAP * (columns - 1)
            if end > first and used + needed > width:
                yield first, end
                first, used = end, own
            used += needed + _GAP
            end += columns
        yield first, end


FORMATS: Mapping[str, Callable[[Table], str]] = {
    "text": Table.text,
    "markdown": Table.markdown,
    "latex": Table.latex,
    "html": Table.html,
    "csv": Table.csv,
}


def folded(line: str, indent: str) -> list[str]:
    """Fold a line at WIDTH characters. Further lines start with `indent`; no word is broken."""
    return textwrap.wrap(
        line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    ) or [""]


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _widths(cells: Sequence[Sequence[str]]) -> list[int]:
    return [max(map(len, column)) for column in zip(*cells, strict=True)]


def _aligned(cells: Sequence[Sequence[str]], labels: int | None) -> list[str]:
    widths = _widths(cells)
    left = len(widths) if labels is None else labels
    return [
        (" " * _GAP)
        .join(
            cell.ljust(width) if place < left else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        .rstrip()
        for row in cells
    ]


# LaTeX --------------------------------------------------------------------------------------------

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}",
}  # fmt: skip
# Font sizes of 8 and 7 points, with the widths of a character and of the gap between columns. Then
# the widths of one column of a printed page, and of the page. All in points.
_SIZES = ((r"\footnotesize", 4.4, 6.0), (r"\scriptsize", 3.9, 6.0), (r"\scriptsize", 3.9, 4.0))
_PLACES = (("table", 252.0), ("table*", 516.0))


def _latex_place(widths: Sequence[int]) -> tuple[str, str, float]:
    """Return the LaTeX float, font size and gap between columns (points) for the column widths.

    Combinations are tried from the narrowest float and the largest font. The result is the first
    one in which the columns fit, or the last one if they fit in none.
    """
    for place, width_pt in _PLACES:
        for size, character_pt, gap_pt in _SIZES:
            if sum(widths) * character_pt + len(widths) * gap_pt <= width_pt:
                return place, size, gap_pt
    return place, size, gap_pt


def _latex_row(row: Sequence[str]) -> str:
    return " & ".join(map(_latex, row)) + r" \\"


def _latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)


# Numbers ------------------------------------------------------------------------------------------


def number(value: float, shape: str = "", scale: float = 1.0, unit: str = "") -> str:
    """Format a value times `scale`, with its unit. A value that is not finite becomes a dash."""
    return "-" if not math.isfinite(value) else f"{scale * value:{shape}}{unit}"


def percent(share: float, shape: str = ".1f") -> str:
    """Format a share in per cent, such as `25.0 %` for 0.25."""
    return number(share, shape, 100.0, " %")


def with_ends(
    estimate: tuple[float, float, float],
    shape: str = "z.0f",
    ends: str = "",
    *,
    scale: float = 1.0,
    unit: str = "",
    chance: float | None = None,
) -> str:
    """Format an estimate, with the ends of its interval and its p-value in brackets, if known.

    Args:
        estimate: value, low end and high end; a NaN low end means that the interval is unknown.
        shape: format of the value.
        ends: format of the ends; empty means that of the value.
        chance: the p-value; None if unknown.
    """
    value, low, high = (scale * part for part in estimate)
    if not math.isfinite(value):
        return "-"
    more = [] if math.isnan(low) else [f"{low:{ends or shape}} to {high:{ends or shape}}"]
    more += [] if chance is None else [p_value(chance)]
    return f"{value:{shape}}{unit}" + (f" ({', '.join(more)})" if more else "")


def rate(share: Share, digits: int = 1, ends: int = 0) -> str:
    """Format a share in per cent, with the ends of its interval in brackets.

    Args:
        digits: number of decimals of the share.
        ends: number of decimals of the ends of the interval.
    """
    return with_ends(
        (share.share, share.low, share.high), f".{digits}f", f".{ends}f", scale=100.0, unit=" %"
    )


def spread(
    value: Interval,
    digits: int,
    scale: float = 1.0,
    sign: str = "",
    chance: float | None = None,
) -> str:
    """Format a value, with the ends of its interval and its p-value in brackets, if known.

    Args:
        chance: the p-value; None if unknown.
    """
    shape = f"{sign or 'z'}.{digits}f"  # the sign of -0.00 shows its side of zero
    return with_ends((value.value, value.low, value.high), shape, scale=scale, chance=chance)


def p_value(chance: float) -> str:
    """Format a p-value in short form, such as `p .03` or `p<.001`."""
    return "p<.001" if chance < 0.001 else f"p {chance:.1g}".replace("p 0.", "p .")
