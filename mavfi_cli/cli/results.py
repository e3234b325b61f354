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
    """Write JSON files, CSV files and pictures to a folder, by name; return the names.

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
    """Print a result as JSON, as CSV or as lines."""
    if as_json:
        echo(json.dumps(contents, indent=2, sort_keys=True))
    elif as_csv:
        echo(table, nl=False)
    else:
        echo_lines(lines)
