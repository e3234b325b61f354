"""Helpers for the scripts that read exported campaigns: counts with intervals, paired tests."""

from __future__ import annotations

import argparse
import collections
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyarrow.parquet as pq

from mavfi_cli.stats.paired import McNemar
from mavfi_cli.stats.shares import Share, clustered_share, wilson

Row = Mapping[str, Any]
Key = tuple[Any, ...]
_MANY = 4  # replans of a golden flight; few flights have more
# What a mission and its golden flight share.
PAIRED = ("world", "world_seed", "seed", "stack", "platform", "planner")


def arguments(text: str | None, by: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """Return an argument parser that accepts exports of campaigns (`mavfi campaign export`).

    With `by`, the parser also has the option --by with this default, for `cells`.
    """
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("parts", nargs="+", help="exports of campaigns, as Parquet")
    if by is not None:
        parser.add_argument(
            "--by", nargs="+", default=[*by], metavar="COLUMN", help="columns that name a cell"
        )
    return parser


def flown(parts: list[str]) -> list[Row]:
    """Return the flown missions of all exports, one row per mission.

    Each row also has `golden_replans`: how often the mission's golden flight without a detector
    replanned ("4 or more" is one value), or "golden lost" if that flight failed. It is empty
    without such a flight.
    """
    rows = [row for part in parts for row in pq.read_table(part).to_pylist()]
    rows = [row for row in rows if row["state"] == "flown"]
    replans = {
        key(row, PAIRED): _replans(row)
        for row in rows
        if row["injected"] == "golden" and not row.get("detector")
    }
    return [row | {"golden_replans": replans.get(key(row, PAIRED), "")} for row in rows]


def _replans(golden: Row) -> str:
    if lost(golden):
        return "golden lost"
    count = golden["replans"]
    return "" if count is None else "4 or more" if count >= _MANY else str(count)


def key(row: Row, names: tuple[str, ...]) -> Key:
    """Return the values of the named columns in a row."""
    return tuple(row[name] for name in names)


def cells(rows: Iterable[Row], by: Sequence[str]) -> dict[tuple[str, ...], list[Row]]:
    """Return the rows that have the same values in the named columns, keyed by these and sorted."""
    found: dict[tuple[str, ...], list[Row]] = collections.defaultdict(list)
    for row in rows:
        found[tuple(str(row.get(name) or "") for name in by)].append(row)
    return dict(sorted(found.items()))


def lost(row: Row) -> bool:
    """Return True if the mission did not end in success."""
    return bool(row["outcome"] != "success")


def golden_lost(rows: list[Row]) -> dict[Key, bool]:
    """Return whether each golden flight was lost, keyed by its values of PAIRED."""
    return {key(row, PAIRED): lost(row) for row in rows if row["injected"] == "golden"}


def share(count: int, total: int) -> str:
    """Return count, total and percentage as text, with the percentage's 95 % Wilson interval."""
    return _text(wilson(count, total))


def share_lost(rows: list[Row]) -> str:
    """Return the share of lost missions as text, with a 95 % interval over their seeds.

    Faults of one seed are alike in all worlds and on all stacks, so each seed is a cluster.
    """
    seeds = [("seeds", row["seed"]) for row in rows]
    return _text(clustered_share([*map(lost, rows)], seeds, {}))


def _text(whole: Share) -> str:
    if whole.total == 0:
        return "0 of 0"
    ends = f"{whole.low:.0%} to {whole.high:.0%}"
    return f"{whole.count} of {whole.total}, {whole.share:.0%} ({ends})"


def against(one: Mapping[Key, bool], other: Mapping[Key, bool]) -> McNemar:
    """Return McNemar's exact test of two arms on the faults that both flew.

    Each mapping has the results of one arm, keyed by fault.
    """
    both = sorted(one.keys() & other.keys(), key=repr)
    return McNemar.of([one[fault] for fault in both], [other[fault] for fault in both])
