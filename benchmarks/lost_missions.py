r"""Counts the lost and the longer missions of flown campaigns, per cell.

    python benchmarks/lost_missions.py docs/results/effects-part*.parquet \
        --by label_setting world label_field
    python benchmarks/lost_missions.py docs/results/paper-mavbench.parquet \
        --by level detector planner golden_replans

Reads exports of campaigns (`mavfi campaign export`). A cell counts golden missions, and missions
whose fault was read. A mission is lost if it does not end in success. It is longer if it succeeds
and takes more than 10 % longer than its own golden flight: the flight without a fault with the same
world, world seed, seed, stack and platform, and without a detector. The last column counts the
missions with an alarm of a detector, and the alarms per hour of flight. `golden_replans` groups by
how often the golden flight without a detector replans. Intervals are Wilson's, 95 %.
"""

from __future__ import annotations

import collections
from collections.abc import Sequence

from exported import PAIRED, Row, arguments, cells, flown, key, lost, share

from mavfi_cli.analysis.pairs import LONGER


def lines(rows: list[Row], by: Sequence[str]) -> list[str]:
    """Return a row of the table for each cell, which is a combination of values of the columns."""
    golden = {
        key(row, PAIRED): row["flight_time_s"]
        for row in rows
        if row["injected"] == "golden" and not row["detector"]
    }
    counted = (r for r in rows if r["injected"] == "golden" or r["activation"] == "read")
    printed = []
    for name, cell in cells(counted, by).items():
        failed = [row for row in cell if lost(row)]
        paired = [row for row in cell if not lost(row) and key(row, PAIRED) in golden]
        longer = sum(row["flight_time_s"] > LONGER * golden[key(row, PAIRED)] for row in paired)
        ends = collections.Counter(row["outcome"] for row in failed)
        text = ", ".join(f"{count} {outcome}" for outcome, count in sorted(ends.items()))
        printed.append(
            f"| {' | '.join(name)} | {share(len(failed), len(cell))} | {longer} of {len(paired)} "
            f"| {text} | {_alarms(cell)} |"
        )
    return printed


def _alarms(cell: list[Row]) -> str:
    counts = [row.get("alarm_count") for row in cell if row["detector"]]
    if not counts:
        return ""
    if None in counts:
        return "not recorded"
    hours = sum(row["flight_time_s"] or 0.0 for row in cell if row["detector"]) / 3600.0
    rate = f", {sum(counts) / hours:.3g} an hour" if hours else ""
    return f"in {sum(map(bool, counts))} of {len(counts)}{rate}"


def main() -> None:
    """Read the exports, and print the table."""
    given = arguments(__doc__, by=["world"]).parse_args()
    print(f"| {' | '.join(given.by)} | lost | longer by > 10 % | ends | alarms |")
    print("|---" * (len(given.by) + 4) + "|")
    print("\n".join(lines(flown(given.parts), given.by)))


if __name__ == "__main__":
    main()
