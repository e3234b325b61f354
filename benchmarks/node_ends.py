r"""Counts how nodes end after instruction-level faults: by a signal, a Python exception, a hang.

    python benchmarks/node_ends.py docs/results/paper-mavbench.parquet

Reads exports of campaigns (`mavfi campaign export`). A row counts the faults that struck a kernel,
and the nodes that ended by a signal of the operating system (native code), by an exception that
Python raised in the wrapper round compiled code, or by a hang. The last column counts the lost
missions among those that ended by an exception.
"""

from __future__ import annotations

import collections

from exported import Row, arguments, flown, lost


def kind_of_end(how: str) -> str:
    """Return "signal", "exception" or "hang" for a value of the column `node_ended`."""
    first = how.split(";")[0]
    if first == "hang":
        return "hang"
    native = first.startswith(("killed by", "ended", "garbled"))
    return "signal" if native else "exception"


def lines(rows: list[Row]) -> list[str]:
    """Return a row of the table for each kernel."""
    kernels: dict[str, list[Row]] = collections.defaultdict(list)
    for row in rows:
        if row["level"] == "instruction" and row["struck_kernel"]:
            kernels[row["struck_kernel"]].append(row)
    printed = []
    for kernel, struck in sorted(kernels.items()):
        ended = [(row, kind_of_end(row["node_ended"])) for row in struck if row["node_ended"]]
        counts = collections.Counter(kind for _, kind in ended)
        raised = sum(lost(row) for row, kind in ended if kind == "exception")
        cells = (kernel, len(struck), *(counts[kind] for kind in ("signal", "exception", "hang")))
        printed.append(f"| {' | '.join(map(str, cells))} | {raised} |")
    return printed


def main() -> None:
    """Read the exports, and print the table."""
    given = arguments(__doc__).parse_args()
    print("| kernel | struck | signal | exception | hang | lost after an exception |")
    print("|---" * 6 + "|")
    print("\n".join(lines(flown(given.parts))))


if __name__ == "__main__":
    main()
