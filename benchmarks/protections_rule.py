r"""Applies the rule of docs/results/replica-protected.toml to its missions.

    python benchmarks/protections_rule.py docs/results/replica-table4-part*.parquet \
        docs/results/replica-protected*.parquet

Reads exports of campaigns (`mavfi campaign export`). Counts the faults in the planner with dead
nodes back after 1 s, in the worlds and seeds that every arm has flown, if the golden flights of
`mavbench-replica` with and without a process for each node succeed. Prints how many missions each
arm loses in each world, and compares each protection with no protection and with the detectors on
the same faults: seeds in which it loses fewer and more missions, the p-value of the exact sign test
of these, corrected by Holm, and McNemar's over missions, which is not. Intervals count each seed as
a cluster.
"""

from __future__ import annotations

import collections
import itertools
import sys

from exported import Key, Row, against, arguments, flown, key, lost, share_lost

from mavfi_cli.stats.paired import McNemar, holm

SCENE = ("world", "world_seed", "seed", "platform")
FAULT = (*SCENE, "fault_target", "fault_seed")
STACK = "mavbench-replica"
BARE = ("no protection", "GAD", "AAD")
ARMS = {  # by stack without its base, and detector
    ("", ""): BARE[0],
    ("", "gad"): BARE[1],
    ("", "aad"): BARE[2],
    ("restores_counters=true", ""): "supervisor",
    ("restores_counters=true", "aad"): "supervisor and AAD",
    ('standby=["planner"]', ""): "hot standby",
    ("processes=[],restores_counters=true", ""): "supervisor, a process for each node",
}


def arm_of(row: Row) -> str:
    """Return the name of a mission's arm, or an empty string if it is in none."""
    base, _, changes = row["stack"].partition(":")
    return ARMS.get((changes, row["detector"] or ""), "") if base == STACK else ""


def is_counted(row: Row) -> bool:
    """Return True for a mission with a fault in the planner, and dead nodes back after 1 s."""
    where = row["level"], row["fault_target"], row["label_node_restart_s"]
    return where == ("instruction", "planning", 1.0)


def sign_test(one: dict[Key, bool], other: dict[Key, bool]) -> McNemar:
    """Return the exact sign test by seed of two arms with the same faults: which loses more."""
    more: collections.Counter[int] = collections.Counter()
    for fault in one:
        more[fault[SCENE.index("seed")]] += one[fault] - other[fault]
    # Each seed in which the arms differ is a pair whose two results differ.
    change = [*more.values()]
    return McNemar.of([count > 0 for count in change], [count < 0 for count in change])


def main() -> None:
    """Read the exports, and print the losses and the comparisons, each as a table."""
    rows = flown(arguments(__doc__).parse_args().parts)
    golden = [
        {key(row, SCENE) for row in rows
         if row["injected"] == "golden" and row["stack"] == stack and not lost(row)}
        for stack in (STACK, f"{STACK}:processes=[]")
    ]  # fmt: skip
    healthy = set.intersection(*golden)
    arms: dict[str, dict[Key, Row]] = {name: {} for name in ARMS.values()}
    for row in filter(is_counted, rows):
        if (name := arm_of(row)) and key(row, SCENE) in healthy:
            arms[name][key(row, FAULT)] = row
    shared = set.intersection(*(set(own) for own in arms.values()))
    if not shared:
        sys.exit("no fault was flown in every arm")
    worlds = sorted({fault[0] for fault in shared})
    print(f"{len(shared)} faults, {len({fault[2] for fault in shared})} seeds\n")
    print(f"| arm | {' | '.join(worlds)} | all |\n" + "|---" * (2 + len(worlds)) + "|")
    for name, own in arms.items():
        cells = [[own[fault] for fault in shared if fault[0] == world] for world in worlds]
        cells.append([own[fault] for fault in shared])
        print(f"| {name} | {' | '.join(map(share_lost, cells))} |")

    hits = {name: {fault: lost(own[fault]) for fault in shared} for name, own in arms.items()}
    pairs = [*itertools.product(BARE, (name for name in arms if name not in BARE))]
    tests = [sign_test(hits[bare], hits[name]) for bare, name in pairs]
    print(
        "\n| protection | against | seeds: fewer, more lost | p | missions: fewer, more | McNemar |"
    )
    print("|---" * 6 + "|")
    corrected = holm([test.p_value for test in tests])
    for (bare, name), test, p in zip(pairs, tests, corrected, strict=True):
        missions = against(hits[bare], hits[name])
        print(
            f"| {name} | {bare} | {test.only_first}, {test.only_second} | {p:.2g} | "
            f"{missions.only_first}, {missions.only_second} | {missions.p_value:.2g} |"
        )


if __name__ == "__main__":
    main()
