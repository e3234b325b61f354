"""Rows as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def csv_text(rows: Iterable[Mapping[str, Any]], names: Sequence[str] = ()) -> str:
    """One line per row, below the names of the columns.

    Args:
        names: names of the columns; None takes the keys of all rows, in order.
    """
    told = list(rows)
    keys = names or list(dict.fromkeys(key for row in told for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(told)
    return text.getvalue()
