r"""Compares the rates at which faults lose flights of mavfi's own companion in two campaigns.

    python benchmarks/lockstep_and_wall.py docs/results/own-lockstep-faults.parquet \
        docs/results/own-wall-faults.parquet
    python benchmarks/lockstep_and_wall.py docs/results/own-built-in-faults.parquet \
        docs/results/own-wall-faults.parquet

Reads two exports of campaigns (`mavfi campaign export`), and applies the rule in their
specifications: the rates agree if the 95 % interval of their difference (Newcombe) lies within 15
points of 0, differ if it excludes 0 and does not lie within them, and else it is undecided. Faults
that struck count. A fault is dead if its process ended.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from exported import Row, arguments, flown, lost, share

from mavfi_cli.stats.shares import wilson

MARGIN = 0.15


def main() -> None:
    """Read the exports, and print the rates, their difference and the verdict."""
    parts = arguments(__doc__).parse_args().parts
    sides = [flown([part]) for part in parts]
    golden = [[row for row in side if row["injected"] == "golden"] for side in sides]
    struck = [[row for row in side if row["activation"]] for side in sides]
    print(f"| | {' | '.join(Path(part).stem for part in parts)} | difference |\n|---|---|---|---|")
    _compare("golden flights lost", golden, lost)
    low, high = _compare("lost, of the faults that struck", struck, lost)
    _compare("dead, of the faults that struck", struck, lambda row: bool(row["node_ended"]))
    within = low >= -MARGIN and high <= MARGIN
    differs = not within and not low <= 0.0 <= high
    print("\nBy the rule:", "agree" if within else "differ" if differs else "undecided")


def _compare(name: str, sides: list[list[Row]], what: Callable[[Row], bool]) -> tuple[float, float]:
    """Print both rates and their difference, and return the interval of the difference."""
    counts = [(sum(map(what, side)), len(side)) for side in sides]
    first, second = (wilson(*pair) for pair in counts)
    gap = second.minus(first)
    cells = " | ".join(share(*pair) for pair in counts)
    print(f"| {name} | {cells} | {gap.value:+.0%} ({gap.low:+.0%} to {gap.high:+.0%}) |")
    return gap.low, gap.high


if __name__ == "__main__":
    main()
