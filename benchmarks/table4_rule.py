r"""Applies the rules of replica-table4.toml and replica-rosfi.toml to missions, all faults counted.

    python benchmarks/table4_rule.py docs/results/replica-table4-part*.parquet

Reads exports of campaigns (`mavfi campaign export`). Prints tables with McNemar's exact test
corrected by Holm: in each world, faults against the golden flights of the same seeds under each
restart rule; the restart rules against 1 s in all worlds, with the share of lost missions whose
fault ended a node; and for each restart rule with detectors, each detector against no protection on
the same faults. The last two count only faults whose golden flight succeeds. The last rows pool the
worlds, which is not part of the rule, and are not corrected. Intervals are Wilson's, 95 %.
"""

from __future__ import annotations

from collections.abc import Mapping

from exported import PAIRED, Key, Row, against, arguments, flown, golden_lost, key, lost, share

from mavfi_cli.stats.paired import McNemar, holm

_USUAL_S = 1.0  # restart that the other restart rules are compared with
FAULT = (*PAIRED, "fault_target", "fault_seed")


def compared(cells: Mapping[tuple[str, ...], McNemar]) -> list[tuple[str, McNemar, float]]:
    """Return the name, the test of *lost* and the corrected p-value of each cell."""
    corrected = holm([test.p_value for test in cells.values()])
    return [
        (" | ".join(name), test, p)
        for (name, test), p in zip(cells.items(), corrected, strict=True)
    ]


def arm(rows: list[Row], *, world: str, detector: str, restart_s: float) -> dict[Key, bool]:
    """Return which faults of one world lose the mission in one arm; an empty world means all."""
    return {
        key(row, FAULT): lost(row)
        for row in rows
        if row["world"].startswith(world)
        and (row["detector"] or "") == detector
        and row["label_node_restart_s"] == restart_s
    }


def main() -> None:
    """Read the exports, and print the tables."""
    rows = flown(arguments(__doc__).parse_args().parts)
    golden = golden_lost(rows)
    faults = [row for row in rows if row["level"] == "instruction" and key(row, PAIRED) in golden]
    worlds = sorted({row["world"] for row in faults})
    restarts = sorted({row["label_node_restart_s"] for row in faults})
    losses = {
        (world, f"{restart_s:g} s"): against(
            {fault: golden[fault[: len(PAIRED)]] for fault in plain}, plain
        )
        for restart_s in restarts
        for world in worlds
        if (plain := arm(faults, world=world, detector="", restart_s=restart_s))
    }
    print("| world | dead nodes back after | lost with the fault only | golden only | p |")
    print("|---|---|---|---|---|")
    for name, test, p in compared(losses):
        print(f"| {name} | {test.only_second} | {test.only_first} | {p:.1g} |")

    healthy = [row for row in faults if not golden[key(row, PAIRED)]]
    compare_restarts(healthy, restarts)
    for restart_s in restarts:
        detectors(healthy, worlds, restart_s)


def compare_restarts(healthy: list[Row], restarts: list[float]) -> None:
    """Print what each restart rule loses without a detector, compared with a restart after 1 s."""
    arms = {
        restart_s: arm(healthy, world="", detector="", restart_s=restart_s)
        for restart_s in restarts
    }
    tests = {
        (f"{restart_s:g} s",): against(arms.get(_USUAL_S, {}), own)
        for restart_s, own in arms.items()
        if restart_s != _USUAL_S
    }
    head = ("dead nodes back after", "lost", "of these, dead nodes", "lost only then")
    print(f"\n| {' | '.join(head)} | only after 1 s | p |")
    print("|---|---|---|---|---|---|")
    compares = {name: (test, p) for name, test, p in compared(tests)}
    for restart_s, own in arms.items():
        name = f"{restart_s:g} s"
        gone = [
            row
            for row in healthy
            if lost(row) and not row["detector"] and row["label_node_restart_s"] == restart_s
        ]
        dead = share(sum(bool(row["node_ended"]) for row in gone), len(gone))
        cells = "| | |"
        if name in compares:
            test, p = compares[name]
            cells = f"{test.only_second} | {test.only_first} | {p:.2g} |"
        print(f"| {name} | {share(sum(own.values()), len(own))} | {dead} | {cells}")


def detectors(healthy: list[Row], worlds: list[str], restart_s: float) -> None:
    """Print what the detectors save under one restart rule, if they were flown under it."""
    pairs = {
        (world or "all", detector): tuple(
            arm(healthy, world=world, detector=name, restart_s=restart_s) for name in ("", detector)
        )
        for world in (*worlds, "")
        for detector in ("gad", "aad")
    }
    if not all(guarded for _, guarded in pairs.values()):
        return
    print(f"\nDead nodes back after {restart_s:g} s:\n")
    print(
        "| world | detector | saved, of the lost | lost with it only | p |\n|---|---|---|---|---|"
    )
    tests = {name: against(plain, guarded) for name, (plain, guarded) in pairs.items()}
    ruled = compared({name: test for name, test in tests.items() if name[0] != "all"})
    pooled = [
        (" | ".join(name), tests[name], tests[name].p_value) for name in tests if name[0] == "all"
    ]
    for name, test, p in ruled + pooled:
        of_lost = share(test.only_first, test.only_first + test.both)
        print(f"| {name} | {of_lost} | {test.only_second} | {p:.2g} |")


if __name__ == "__main__":
    main()
