"""Shared by the scripts on flown campaigns: exports, counts with intervals, paired tests."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

import pyarrow.parquet as pq

from mavfi_cli.stats.paired import McNemar
from mavfi_cli.stats.shares import wilson

Row = Mapping[str, Any]
Key = tuple[Any, ...]


def arguments(text: str | None) -> argparse.ArgumentParser:
    """A parser that takes exports of campaigns (`mavfi campaign export`)."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("parts", nargs="+", help="exports of campaigns, as Parquet")
    return parser


def flown(parts: list[str]) -> list[Row]:
    """The flown missions of all parts."""
    rows = [row for part in parts for row in pq.read_table(part).to_pylist()]
    return [row for row in rows if row["state"] == "flown"]


def key(row: Row, names: tuple[str, ...]) -> Key:
    """The values of some columns."""
    return tuple(row[name] for name in names)


def lost(row: Row) -> bool:
    """Whether the mission does not end in success."""
    return bool(row["outcome"] != "success")


def share(count: int, total: int) -> str:
    """Count, total and percentage with its Wilson interval, 95 %."""
    if total == 0:
        return "0 of 0"
    whole = wilson(count, total)
    return f"{count} of {total}, {whole.share:.0%} ({whole.low:.0%} to {whole.high:.0%})"


def against(one: Mapping[Key, bool], other: Mapping[Key, bool]) -> McNemar:
    """McNemar's exact test of what happened to the faults that both arms flew."""
    both = sorted(one.keys() & other.keys(), key=repr)
    return McNemar.of([one[fault] for fault in both], [other[fault] for fault in both])
