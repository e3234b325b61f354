r"""Counts the missions that instruction-level faults lose, apart for silent faults and dead nodes.

    python benchmarks/silent_and_dead.py docs/results/replica-table4-part1.parquet \
        --by world label_node_restart_s detector

Reads exports of campaigns (`mavfi campaign export`). A mission counts if its golden flight (the
same world, world seed, seed, stack and platform) succeeded. The first column of counts has all
faults, as the paper counts, and the others those that were read or ended their node. A fault is
dead if its node ended, and silent otherwise. The last column has those of the dead whose node ended
by an exception that Python raised in the wrapper round compiled code, which a companion without
Python does not have. A mission is lost if it does not end in success. Intervals are Wilson's, 95 %,
and take the missions of each seed as a cluster.
"""

from __future__ import annotations

from exported import PAIRED, arguments, cells, flown, golden_lost, key, share_lost
from node_ends import kind_of_end


def main() -> None:
    """Read the exports, and print a row for each combination of values of the columns."""
    given = arguments(__doc__, by=["world"]).parse_args()
    rows = flown(given.parts)
    golden = golden_lost(rows)
    struck = [row for row in rows if row["level"] == "instruction"]
    counted = [row for row in struck if golden.get(key(row, PAIRED)) is False]
    lost = ("all faults: lost", "lost", "lost, dead node", "lost, silent", "lost, exception")
    print(f"| {' | '.join((*given.by, *lost))} |")
    print("|---" * (len(given.by) + len(lost)) + "|")
    for name, cell in cells(counted, given.by).items():
        dead = [row for row in cell if row["node_ended"]]
        silent = [row for row in cell if row["activation"] == "read" and not row["node_ended"]]
        raised = [row for row in dead if kind_of_end(row["node_ended"]) == "exception"]
        parts = (cell, dead + silent, dead, silent, raised)
        print(f"| {' | '.join(name)} | {' | '.join(map(share_lost, parts))} |")


if __name__ == "__main__":
    main()
