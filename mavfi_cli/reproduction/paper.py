"""The paper's printed numbers, from paper.toml."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from mavfi_cli.core.config import read_toml
from mavfi_cli.report.tables.paper_table import Printed

_FILE = Path(__file__).parent / "paper.toml"


@cache
def _data() -> Mapping[str, Any]:
    return read_toml(_FILE)[0]


def printed(item: str, *keys: object) -> Printed:
    """A number that the paper prints, or its words; None if it prints nothing there."""
    found: Any = _data().get(item, {})
    for key in keys:
        found = found.get(str(key)) if isinstance(found, Mapping) else None
    if found is None or isinstance(found, str):
        return found
    return float(found)


def source(item: str) -> str:
    """Where the paper prints the numbers of an item, and what it only draws."""
    data = _data()[item]
    drawn = f"; {data['unprinted']}: drawn only" if "unprinted" in data else ""
    return f"paper: {data['source']}{drawn}"
