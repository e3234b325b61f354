r"""Counts how nodes end after instruction-level faults: by a signal, a Python exception, a hang.

    python benchmarks/node_ends.py docs/results/paper-mavbench.parquet
    python benchmarks/node_ends.py docs/results/factorial-*.parquet \
        --by label_node_restart_s label_setting register

Reads exports of campaigns (`mavfi campaign export`). A row counts the faults that struck a kernel,
or that have the same values in the columns of --by (`register` is the kind of the struck register),
and the nodes that ended by a signal of the operating system (native code), by an exception that
Python raised in the wrapper round compiled code, or by a hang. The last column counts the lost
missions among those that ended by an exception.
"""

from __future__ import annotations

import collections

from exported import Key, Row, arguments, flown, key, lost


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


def lines(rows: list[Row], names: tuple[str, ...]) -> list[str]:
    """Return a row of the table for each value of the named columns."""
    groups: dict[Key, list[Row]] = collections.defaultdict(list)
    for row in rows:
        if row["level"] == "instruction" and row["struck_kernel"]:
            groups[key({**row, "register": register(row)}, names)].append(row)
    printed = []
    for place, struck in sorted(groups.items(), key=repr):
        ended = [(row, kind_of_end(row["node_ended"])) for row in struck if row["node_ended"]]
        counts = collections.Counter(kind for _, kind in ended)
        raised = sum(lost(row) for row, kind in ended if kind == "exception")
        cells = (*place, len(struck), *(counts[kind] for kind in ("signal", "exception", "hang")))
        printed.append(f"| {' | '.join(map(str, cells))} | {raised} |")
    return printed


def main() -> None:
    """Read the exports, and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--by", nargs="+", default=["struck_kernel"], metavar="COLUMN",
                        help="columns of a group")  # fmt: skip
    given = parser.parse_args()
    titles = [name.removeprefix("struck_").removeprefix("label_") for name in given.by]
    titles += ["struck", "signal", "exception", "hang", "lost after an exception"]
    print(f"| {' | '.join(titles)} |")
    print("|---" * len(titles) + "|")
    print("\n".join(lines(flown(given.parts), tuple(given.by))))


if __name__ == "__main__":
    main()
