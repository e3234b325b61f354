r"""Prints how much each of five factors changes what faults in instructions cost.

    python benchmarks/factorial.py --many factorial-many.parquet --fixed factorial-fixed.parquet

Reads exports of `docs/results/factorial-many.toml` and `factorial-fixed.toml`. The latter states
the rule, which was written before the flights. A mission counts if its golden flight succeeded, and
is lost if it does not end in success. The effect of a factor is the share of missions that its
second level loses, minus that of its first level, as a mean over worlds and seeds. Intervals are
bootstrap intervals over worlds and seeds, 95 %. The effects of the factors that matter are printed
again at each level of the others; these were not part of the rule.
"""

from __future__ import annotations

import argparse
import collections
import itertools

import numpy as np
from exported import PAIRED, Key, Row, flown, golden_lost, key, lost, share

from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.paired import holm, sign_flips

Cells = dict[tuple[bool, ...], list[bool]]  # whether each mission was lost, by levels
PAPER_POINTS = 100.0 * (380 / 400 - 1058 / 1200)  # Table IV, all worlds: golden minus faults
FACTORS = {
    "worlds": ("one for each seed", "fixed"),
    "follower's rate": ("ours", "the release's"),
    "smoothing": ("ours", "the release's"),
    "dead nodes": ("back after 1 s", "never back"),
    "injector": ("any bit, by execution", "ROSFI's"),
}


def levels(row: Row, *, fixed: bool) -> tuple[bool, ...]:
    """Return whether a mission has the second level of each factor, in the order of FACTORS."""
    stack = row["label_stack"]
    replica = stack == "mavbench-replica"
    return (
        fixed,
        replica or "slice_period_s" in stack,
        replica or "smoother" in stack,
        float(row["label_node_restart_s"]) > 1.0,
        "ROSFI" in row["label_setting"],
    )


def outcomes(parts: list[str], *, fixed: bool) -> dict[Key, Cells]:
    """Return whether each mission with a fault was lost, by world and seed, then by levels.

    Missions whose golden flight is lost are left out.
    """
    rows = flown(parts)
    golden = golden_lost(rows)
    cells: dict[Key, Cells] = collections.defaultdict(dict)
    for row in rows:
        if row["injected"] != "golden" and golden.get(key(row, PAIRED)) is False:
            cell = cells[key(row, ("world", "seed"))]
            cell.setdefault(levels(row, fixed=fixed), []).append(lost(row))
    return cells


def main() -> None:
    """Read the exports, and print the losses of the corners and the effects of the factors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--many", nargs="+", required=True, help="exports of factorial-many")
    parser.add_argument("--fixed", nargs="+", required=True, help="exports of factorial-fixed")
    given = parser.parse_args()
    many, fixed = outcomes(given.many, fixed=False), outcomes(given.fixed, fixed=True)
    blocks = [many[place] | fixed[place] for place in sorted(many.keys() & fixed.keys())]
    corners = set(itertools.product((False, True), repeat=len(FACTORS)))
    whole = [block for block in blocks if block.keys() == corners]
    print(f"{len(whole)} of {len(blocks)} worlds and seeds have missions in all 32 cells\n")
    for name, corner in (("first", False), ("second", True)):
        hits = [hit for block in whole for hit in block[(corner,) * len(FACTORS)]]
        print(f"{name} level of every factor: lost {share(sum(hits), len(hits))}")
    effects, tests = [], []
    for place in range(len(FACTORS)):
        changes = np.array([change(block, place) for block in whole])
        effects.append(interval(100.0 * changes))
        tests.append(sign_flips(changes))
    print("\n| factor | from | to | points | share of the paper's gap | p |")
    print("|---" * 6 + "|")
    for (name, ends), effect, p in zip(FACTORS.items(), effects, holm(tests), strict=True):
        print(
            f"| {name} | {' | '.join(ends)} | {effect.value:+.1f} ({effect.low:.1f} to "
            f"{effect.high:.1f}) | {effect.value / PAPER_POINTS:.0%} | {p:.2g} |"
        )
    names = [*FACTORS]
    matter = [place for place, p in enumerate(holm(tests)) if p < 0.05]
    for place, other in itertools.permutations(matter, 2):
        for level, end in enumerate(FACTORS[names[other]]):
            at = [{c: hits for c, hits in block.items() if c[other] is bool(level)}
                  for block in whole]  # fmt: skip
            effect = interval(100.0 * np.array([change(block, place) for block in at]))
            print(f"{names[place]}, if {names[other]}: {end}: {effect.value:+.1f} points "
                  f"({effect.low:.1f} to {effect.high:.1f})")  # fmt: skip


def change(block: Cells, place: int) -> float:
    """Return the loss at a factor's second level minus that at its first, mean over the others."""
    means = [
        [np.mean(hits) for corner, hits in block.items() if corner[place] is level]
        for level in (False, True)
    ]
    return float(np.mean(means[1]) - np.mean(means[0]))


if __name__ == "__main__":
    main()
