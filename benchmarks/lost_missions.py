r"""Lost and longer missions of flown campaigns, cell by cell.

    python benchmarks/lost_missions.py docs/results/effects-part*.parquet \
        --by label_setting world label_field

Reads exports of campaigns (`mavfi campaign export`). A cell counts the missions whose fault was
read. A mission is lost if it does not end in success. It is longer if it succeeds and takes more
than 5 % longer than its own golden flight: the flight of the setting `golden` with the same world,
world seed, seed, stack and platform. Intervals are Wilson's, 95 %.
"""

from __future__ import annotations

import argparse
import collections
from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow.parquet as pq
from scipy.stats import binomtest

Row = Mapping[str, Any]
PAIRED = ("world", "world_seed", "seed", "stack", "platform")
LONGER = 1.05


def share(count: int, total: int) -> str:
    """Count, total and percentage with its interval."""
    if total == 0:
        return "0 of 0"
    ci = binomtest(count, total).proportion_ci(method="wilson")
    return f"{count} of {total}, {count / total:.0%} ({ci.low:.0%} to {ci.high:.0%})"


def pair(row: Row) -> tuple[Any, ...]:
    """What a flight shares with its golden one."""
    return tuple(row[key] for key in PAIRED)


def lines(rows: list[Row], by: Iterable[str]) -> list[str]:
    """A line for each cell."""
    golden = {pair(r): r["flight_time_s"] for r in rows if r["injected"] == "golden"}
    cells: dict[tuple[str, ...], list[Row]] = collections.defaultdict(list)
    for row in rows:
        if row["injected"] == "golden" or row["activation"] == "read":
            cells[tuple(str(row.get(key) or "") for key in by)].append(row)
    printed = []
    for name, cell in sorted(cells.items()):
        lost = [row for row in cell if row["outcome"] != "success"]
        paired = [row for row in cell if row["outcome"] == "success" and pair(row) in golden]
        longer = sum(row["flight_time_s"] > LONGER * golden[pair(row)] for row in paired)
        ends = collections.Counter(row["outcome"] for row in lost)
        text = ", ".join(f"{count} {outcome}" for outcome, count in sorted(ends.items()))
        printed.append(
            f"| {' | '.join(name)} | {share(len(lost), len(cell))} | {longer} of {len(paired)} "
            f"| {text} |"
        )
    return printed


def main() -> None:
    """Read, count, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="+", help="exports of campaigns, as Parquet")
    parser.add_argument("--by", nargs="+", required=True, help="columns that name a cell")
    given = parser.parse_args()
    rows = [row for part in given.parts for row in pq.read_table(part).to_pylist()]
    flown = [row for row in rows if row["state"] == "flown"]
    print(f"| {' | '.join(given.by)} | lost | longer by > 5 % | ends |")
    print("|---" * (len(given.by) + 3) + "|")
    print("\n".join(lines(flown, given.by)))


if __name__ == "__main__":
    main()
