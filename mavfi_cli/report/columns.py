"""Formats numbers as cells, and rows of cells as aligned columns of text or as CSV."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

WIDTH = 100  # characters; default maximum width of a table
_GAP = 2
_LEAST_ROOM = 20  # characters; minimum width of the prose column


def columns(rows: Iterable[Sequence[str]], labels: int | None = None) -> list[str]:
    """Return one aligned line per row, with two blanks between the cells.

    Args:
        rows: Rows of cells, headings first if there are any. Rows may differ in length.
        labels: Number of left-aligned columns; the others are right-aligned. None aligns all left.
    """
    return _aligned(_padded(rows), labels)


def blocks(rows: Iterable[Sequence[str]], labels: int, width: int = WIDTH) -> list[str]:
    """Split the columns into several tables, each at most `width` characters wide.

    Every table repeats the first `labels` columns and has at least one other column. An empty line
    separates two tables.
    """
    cells = _padded(rows)
    lines: list[str] = []
    for first, end in _cut(_widths(cells), labels, width):
        part = [row[:labels] + row[first:end] for row in cells]
        lines += ([""] if lines else []) + _aligned(part, labels)
    return lines


def wrapped(rows: Iterable[Sequence[str]], width: int = WIDTH) -> list[str]:
    """Align all columns left and wrap the last one, which is prose, at `width`."""
    cells = _padded(rows)
    room = width - sum(each + _GAP for each in _widths(cells)[:-1])
    lines = []
    for *row, prose in cells:
        first, *rest = textwrap.wrap(prose, max(room, _LEAST_ROOM)) or [""]
        lines += [[*row, first], *([""] * len(row) + [each] for each in rest)]
    return _aligned(lines, None)


def _cut(widths: Sequence[int], labels: int, width: int) -> Iterator[tuple[int, int]]:
    """Yield the first column of each table and the column after its last."""
    own = sum(each + _GAP for each in widths[:labels])
    first, used = labels, own
    for place in range(labels, len(widths)):
        if place > first and used + widths[place] > width:
            yield first, place
            first, used = place, own
        used += widths[place] + _GAP
    yield first, len(widths)


def _padded(rows: Iterable[Sequence[str]]) -> list[list[str]]:
    found = [list(row) for row in rows]
    count = max(map(len, found), default=0)
    return [row + [""] * (count - len(row)) for row in found]


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


# Numbers ------------------------------------------------------------------------------------------

Row = Mapping[str, Any]


def number(value: float, shape: str = "", scale: float = 1.0, unit: str = "") -> str:
    """A value in a format specification, with its unit."""
    return "-" if not math.isfinite(value) else f"{scale * value:{shape}}{unit}"


def percent(share: float, shape: str = ".1f") -> str:
    """A share of one as per cent."""
    return number(share, shape, 100.0, " %")


def rate(share: Row, digits: int = 1) -> str:
    """A share as per cent, with its interval."""
    if math.isnan(share["share"]):
        return "-"
    told = f"{100 * share['share']:.{digits}f} %"
    return f"{told} ({100 * share['low']:.0f} to {100 * share['high']:.0f})"


def spread(
    each: Row, digits: int, scale: float = 1.0, sign: str = "", chance: float | None = None
) -> str:
    """A value, with its interval and p-value if there are any."""
    if math.isnan(each["value"]):
        return "-"
    shape = f"{sign or 'z'}.{digits}f"  # the sign of -0.00 shows its side of zero
    value, low, high = (f"{scale * each[end]:{shape}}" for end in ("value", "low", "high"))
    told = [] if math.isnan(each["low"]) else [f"{low} to {high}"]
    told += [] if chance is None else [p_value(chance)]
    return f"{value} ({', '.join(told)})" if told else value


def p_value(chance: float) -> str:
    """A p-value in short form."""
    return "p<.001" if chance < 0.001 else f"p {chance:.1g}".replace("p 0.", "p .")


# CSV ----------------------------------------------------------------------------------------------


def csv_text(rows: Iterable[Mapping[str, Any]], names: Sequence[str] = ()) -> str:
    """One line per row, below the names of the columns.

    Args:
        names: names of the columns; empty takes the keys of all rows, in order.
    """
    told = list(rows)
    keys = names or list(dict.fromkeys(key for row in told for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(told)
    return text.getvalue()
