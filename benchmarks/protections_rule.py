r"""Compares protections of `mavbench-replica` on the same faults, with dead nodes back after 1 s.

    python benchmarks/protections_rule.py docs/results/replica-table4-part*.parquet \
        docs/results/replica-protected*.parquet
    python benchmarks/protections_rule.py docs/results/replica-kills*.parquet

Reads exports of campaigns (`mavfi campaign export`). Counts the faults that were flown without a
protection and with at least one, if the golden flights of their world and seed, with and without a
process for each node, succeed. The first table has the missions that each arm loses. The second
compares each protection with no protection and with the detectors, all worlds together; it applies
the rule of docs/results/replica-protected.toml. The third compares each arm with no protection in
each world, as the rule of docs/results/replica-planning.toml does.

A comparison counts the faults that both arms flew: the seeds in which the first arm loses fewer and
more missions, with the exact sign test, and missions, with McNemar's exact test. Each p-value is
followed by the same one corrected by Holm for all rows of its table. Faults of one seed are alike
in all worlds, so the test by mission takes more for independent than is. Intervals count each seed
as a cluster.
"""

from __future__ import annotations

import collections
import itertools
import sys
from collections.abc import Iterable, Mapping

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
    ("processes=[]", ""): "a process for each node",
    ("processes=[],restores_counters=true", ""): "supervisor, a process for each node",
    ('processes=[],standby=["planner"]', ""): "hot standby, a process for each node",
}
Hits = Mapping[Key, bool]  # whether each mission was lost, by fault


def arm_of(row: Row) -> str:
    """Return the name of a mission's arm, or an empty string if it is in none."""
    base, _, changes = row["stack"].partition(":")
    return ARMS.get((changes, row["detector"] or ""), "") if base == STACK else ""


def arms_of(rows: list[Row]) -> dict[str, dict[Key, Row]]:
    """Return the missions that count by their fault, for each arm that has any."""
    golden = {key(row, SCENE) for row in rows if row["injected"] == "golden"}
    bad = {key(row, SCENE) for row in rows if row["injected"] == "golden" and lost(row)}
    arms: dict[str, dict[Key, Row]] = {name: {} for name in ARMS.values()}
    for row in rows:
        restarts = row.get("label_node_restart_s") in (None, 1.0)  # 1 s is the default
        if restarts and row["injected"] != "golden" and key(row, SCENE) in golden - bad:
            arms.setdefault(arm_of(row), {})[key(row, FAULT)] = row
    arms.pop("", None)
    protected = set().union(*(own for name, own in arms.items() if name not in BARE))
    counted = protected & arms[BARE[0]].keys()
    chosen = {
        name: {fault: own[fault] for fault in sorted(counted & own.keys(), key=repr)}
        for name, own in arms.items()
    }
    return {name: own for name, own in chosen.items() if own}


def sign_test(one: Hits, other: Hits) -> McNemar:
    """Return the exact sign test by seed of two arms: which loses more of the shared faults."""
    more: collections.Counter[int] = collections.Counter()
    for fault in one.keys() & other.keys():
        more[fault[SCENE.index("seed")]] += one[fault] - other[fault]
    # Each seed in which the arms differ is a pair whose two results differ.
    change = [*more.values()]
    return McNemar.of([count > 0 for count in change], [count < 0 for count in change])


def compared(pairs: Iterable[tuple[str, str, str, Hits, Hits]]) -> list[str]:
    """Return a table of comparisons.

    Args:
        pairs: world, name of the arm, name of the arm that it is compared with, and whether each
            mission of the first and of the other arm was lost.
    """
    rows = [(names, sign_test(other, one), against(other, one)) for *names, one, other in pairs]
    by_seed, by_mission = (holm([row[place].p_value for row in rows]) for place in (1, 2))
    titles = ["world", "protection", "against", "seeds: fewer, more lost", "p", "Holm"]
    titles += ["missions: fewer, more", "McNemar", "Holm"]
    lines = ["", f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for (names, seeds, missions), *corrected in zip(rows, by_seed, by_mission, strict=True):
        cells = [*names]
        for test, p in zip((seeds, missions), corrected, strict=True):
            cells += [f"{test.only_first}, {test.only_second}", f"{test.p_value:.3g}", f"{p:.3g}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Read the exports, and print the losses and the comparisons, each as a table."""
    arms = arms_of(flown(arguments(__doc__).parse_args().parts))
    if not arms:
        sys.exit("no fault was flown both without and with a protection")
    faults = arms[BARE[0]]
    worlds = sorted({fault[0] for fault in faults})
    print(f"{len(faults)} faults, {len({fault[2] for fault in faults})} seeds\n")
    print(f"| arm | {' | '.join(worlds)} | all |\n" + "|---" * (2 + len(worlds)) + "|")
    for name, own in arms.items():
        cells = [[row for row in own.values() if row["world"] == world] for world in worlds]
        cells.append([*own.values()])
        print(f"| {name} | {' | '.join(map(share_lost, cells))} |")

    hits = {name: {fault: lost(row) for fault, row in own.items()} for name, own in arms.items()}
    protections = [name for name in arms if name not in BARE]
    known = [name for name in BARE if name in arms]
    whole = [
        ("all", name, bare, hits[name], hits[bare])
        for bare, name in itertools.product(known, protections)
    ]
    others = [name for name in arms if name != BARE[0]]
    by_world = [
        (world, name, BARE[0], *({fault: own[fault] for fault in own if fault[0] == world}
                                 for own in (hits[name], hits[BARE[0]])))
        for world, name in itertools.product(worlds, others)
    ]  # fmt: skip
    print("\n".join([*compared(whole), *compared(by_world)]))


if __name__ == "__main__":
    main()
