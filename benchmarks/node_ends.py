r"""Counts how nodes end after instruction-level faults: by a signal, a Python exception, a hang.

    python benchmarks/node_ends.py docs/results/paper-mavbench.parquet
    python benchmarks/node_ends.py docs/results/factorial-*.parquet \
        --by label_node_restart_s label_setting register

Reads exports of campaigns (`mavfi campaign export`). A row counts the struck faults that have the
same values in the columns of --by (by default the kernel; `register` is the kind of the struck
register). It counts the nodes that ended by a signal of the operating system (native code), by an
exception that Python raised in the wrapper round compiled code, or by a hang. The last column
counts the lost missions among those that ended by an exception.
"""

from __future__ import annotations

import collections
from collections.abc import Sequence

from exported import Row, arguments, cells, flown, lost


def kind_of_end(how: str) -> str:
    """Return "signal", "exception" or "hang" for a value of the column `node_ended`."""
    first = how.split(";")[0]
    if first == "hang":
        return "hang"
    native = first.startswith(("killed by", "ended", "garbled"))
    return "signal" if native else "exception"


def register(row: Row) -> str:
    """Return the kind of the register that a fault struck, or "" if it struck none."""
    name = row["struck_register"] or ""
    kinds = {"rsp": "stack pointer", "rflags": "flags", "rip": "instruction pointer"}
    return kinds.get(name) or {"r": "general", "z": "vector"}.get(name[:1], name)


def lines(rows: list[Row], by: Sequence[str]) -> list[str]:
    """Return a row of the table for each combination of values of the columns."""
    counted = (
        {**row, "register": register(row)}
        for row in rows
        if row["level"] == "instruction" and row["struck_kernel"]
    )
    printed = []
    for place, struck in cells(counted, by).items():
        ended = [(row, kind_of_end(row["node_ended"])) for row in struck if row["node_ended"]]
        counts = collections.Counter(kind for _, kind in ended)
        raised = sum(lost(row) for row, kind in ended if kind == "exception")
        numbers = len(struck), *(counts[kind] for kind in ("signal", "exception", "hang")), raised
        printed.append(f"| {' | '.join((*place, *map(str, numbers)))} |")
    return printed


def main() -> None:
    """Read the exports, and print the table."""
    given = arguments(__doc__, by=["struck_kernel"]).parse_args()
    titles = [*given.by, "struck", "signal", "exception", "hang", "lost after an exception"]
    print(f"| {' | '.join(titles)} |")
    print("|---" * len(titles) + "|")
    print("\n".join(lines(flown(given.parts), given.by)))


if __name__ == "__main__":
    main()
