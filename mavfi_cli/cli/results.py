"""Saves and prints the result of a study, such as a comparison or an evaluation."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.core.terminal import echo, echo_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(
    out: Path, contents: Mapping[str, object], tables: Mapping[str, str],
    pictures: Mapping[str, Figure],
) -> list[str]:  # fmt: skip
    """Write the results of a study to a folder, and return the names of the files.

    Args:
        out: the folder, which is created if it does not exist.
        contents: the contents of JSON files, keyed by file name.
        tables: the texts of CSV files, keyed by file name.
        pictures: figures, keyed by file name.

    Raises:
        RecordError: a file cannot be written.
    """
    from mavfi_cli.core.files import write_json, write_text, writing
    from mavfi_cli.report.drawing import write_figure

    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        write_json(out / name, content)
    for name, table in tables.items():
        write_text(out / name, table)
    for name, figure in pictures.items():
        write_figure(figure, out / name)
    return [*contents, *tables, *pictures]


def show(contents: Any, table: str, lines: Iterable[str], *, as_json: bool, as_csv: bool) -> None:
    """Print the result of a study as JSON, as CSV, or by default as lines of text.

    Args:
        contents: the result, as values that JSON can represent.
        table: the result as CSV.
        lines: the result as text.
    """
    if as_json:
        echo(json.dumps(contents, indent=2, sort_keys=True))
    elif as_csv:
        echo(table, nl=False)
    else:
        echo_lines(lines)
