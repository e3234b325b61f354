r"""Prints how much each of five factors changes what faults in instructions cost.

    python benchmarks/factorial.py --many factorial-many.parquet --fixed factorial-fixed.parquet

Reads exports of `docs/results/factorial-many.toml` and `factorial-fixed.toml`. The latter states
the rule, which was written before the flights. A mission counts if its golden flight succeeded, and
is lost if it does not end in success. The effect of a factor is the share of missions that its
second level loses, minus that of its first level, as a mean over worlds and seeds. Intervals are
bootstrap intervals over worlds and seeds, 95 %.

Faults of one seed are drawn alike in all worlds and on all stacks. "p by seed" and the last two
tables, which were not part of the rule, therefore count each seed once. The last table has all 32
combinations.
"""

from __future__ import annotations

import argparse
import collections
import itertools
from collections.abc import Mapping

import numpy as np
from exported import PAIRED, Key, Row, flown, golden_lost, key, lost, share

from mavfi_cli.paper.items import printed
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.paired import holm, sign_flips
from mavfi_cli.stats.shares import Interval, clustered_share

Cells = dict[tuple[bool, ...], list[bool]]  # whether each mission was lost, by levels
PAPER_LOSS = 100.0 * (380 / 400 - 1058 / 1200)  # Table IV, all worlds: golden minus faults
FACTORS = {
    "worlds": ("one for each seed", "fixed"),
    "follower's rate": ("ours", "the release's"),
    "smoothing": ("ours", "the release's"),
    "dead nodes": ("back after 1 s", "never back"),
    "injector": ("any bit of any operand", "ROSFI's registers and bits"),
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
    blocks = {place: many[place] | fixed[place] for place in sorted(many.keys() & fixed.keys())}
    corners = set(itertools.product((False, True), repeat=len(FACTORS)))
    whole = {place: block for place, block in blocks.items() if block.keys() == corners}
    print(f"{len(whole)} of {len(blocks)} worlds and seeds have missions in all 32 cells\n")
    for name, level in (("first", False), ("second", True)):
        hits = [hit for block in whole.values() for hit in block[(level,) * len(FACTORS)]]
        print(f"{name} level of every factor: lost {share(sum(hits), len(hits))}")
    last, first = ((level,) * len(FACTORS) for level in (True, False))
    apart = [float(np.mean(each[last]) - np.mean(each[first])) for each in whole.values()]
    print(f"all five factors together: {text(interval(100.0 * np.array(apart)), '+')} points")

    effects, tests, by_seed, in_worlds = [], [], [], []
    for place in range(len(FACTORS)):
        changes = {where: change(block, place) for where, block in whole.items()}
        effects.append(interval(100.0 * np.array([*changes.values()])))
        tests.append(sign_flips([*changes.values()]))
        by_seed.append(sign_flips(of_seeds(changes)))
        own: dict[str, list[float]] = collections.defaultdict(list)
        for (world, _), points in changes.items():
            own[world].append(100.0 * points)
        in_worlds.append({world: interval(np.array(points)) for world, points in own.items()})
    print("\n| factor | from | to | points | share of the paper's loss | p | p by seed |")
    print("|---" * 7 + "|")
    rows = zip(FACTORS.items(), effects, holm(tests), holm(by_seed), strict=True)
    for (name, ends), effect, p, p_seeds in rows:
        print(
            f"| {name} | {' | '.join(ends)} | {text(effect, '+')} | "
            f"{effect.value / PAPER_LOSS:.0%} | {p:.2g} | {p_seeds:.2g} |"
        )

    print(f"\n| factor | {' | '.join(in_worlds[0])} |\n" + "|---" * (1 + len(in_worlds[0])) + "|")
    for name, by_world in zip(FACTORS, in_worlds, strict=True):
        cells = (
            f"{text(effect, '+')}, {effect.value / paper_loss(world):.0%}"
            for world, effect in by_world.items()
        )
        print(f"| {name} | {' | '.join(cells)} |")

    for names in (["worlds", "dead nodes", "injector"], [*FACTORS]):
        print("\n".join(losses(blocks, names)))


def losses(blocks: Mapping[Key, Cells], names: list[str]) -> list[str]:
    """Return a table of the missions lost at each combination of levels of the named factors.

    The first percentage counts each seed once, with its bootstrap interval, which has no width if
    nothing was lost. The second is that of all missions, with Wilson's interval and each seed as a
    cluster. The last column is the second minus the paper's.
    """
    titles = [*names, "lost", "% (bootstrap)", "% (Wilson)", "minus the paper's, points"]
    lines = ["", f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    places = [[*FACTORS].index(name) for name in names]
    for chosen in itertools.product((False, True), repeat=len(names)):
        cells = {
            where: [hit for corner, hits in block.items() for hit in hits
                    if tuple(corner[place] for place in places) == chosen]
            for where, block in blocks.items()
        }  # fmt: skip
        hits = [(hit, ("seeds", seed)) for (_, seed), cell in cells.items() for hit in cell]
        whole = clustered_share(*zip(*hits, strict=True), {})
        by_seed = of_seeds({where: float(np.mean(cell)) for where, cell in cells.items() if cell})
        own, beyond = (
            Interval(
                value=100.0 * whole.share - less,
                low=100.0 * whole.low - less,
                high=100.0 * whole.high - less,
                count=whole.total,
            )
            for less in (0.0, PAPER_LOSS)
        )
        rates = interval(100.0 * np.array(by_seed))
        numbers = text(rates, ""), text(own, ""), text(beyond, "+")
        ends = [FACTORS[name][level] for name, level in zip(names, chosen, strict=True)]
        lines.append(f"| {' | '.join((*ends, f'{whole.count} of {whole.total}', *numbers))} |")
    return lines


def paper_loss(world: str) -> float:
    """Return the points of success that faults cost in a world of the paper's Table IV."""
    golden, faulty = (
        printed("table4", "success_percent", kind, world) for kind in ("golden", "none")
    )
    assert isinstance(golden, float)
    assert isinstance(faulty, float)
    return golden - faulty


def of_seeds(values: Mapping[Key, float]) -> list[float]:
    """Return the mean over worlds of each seed's values, given by world and seed."""
    by_seed: dict[int, list[float]] = collections.defaultdict(list)
    for (_, seed), value in values.items():
        by_seed[seed].append(value)
    return [float(np.mean(own)) for own in by_seed.values()]


def text(effect: Interval, sign: str) -> str:
    """Return an effect with its interval as text."""
    return f"{effect.value:{sign}.1f} ({effect.low:.1f} to {effect.high:.1f})"


def change(block: Cells, place: int) -> float:
    """Return the loss at a factor's second level minus that at its first, mean over the others."""
    means = [
        [np.mean(hits) for corner, hits in block.items() if corner[place] is level]
        for level in (False, True)
    ]
    return float(np.mean(means[1]) - np.mean(means[0]))


if __name__ == "__main__":
    main()
