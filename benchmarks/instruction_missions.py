"""Measures how much longer a whole mission takes with an instruction-level fault, per node.

    python benchmarks/instruction_missions.py [--pairs 7] [--fault-seeds 1] [--node NAME ...]

For each attacked kernel (with three planners) and fault seed, a first command draws the fault and
keeps the kernel's profile (the first command of a mission also keeps its golden flight). Then the
golden mission and the mission with the fault are flown in turn, each by a whole command. The output
has the medians of their wall times, the ratio of the medians with its range over the pairs, the
same for processor time, and the time of the first command. Target: at most 1.3 times the wall time.
`--null` injects without the flip, so that both missions are the same flight; otherwise a longer or
shorter faulty flight affects the ratio. All missions fly the stack `hardened`.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

from missions import fly, fly_pairs

LIMIT = 1.3
NODES = ("point_cloud", "octomap", "collision_check", "control", "rrtstar", "rrt", "rrtconnect")
PLANNERS = ("rrtstar", "rrt", "rrtconnect")


def ratio(attacked: list[float], golden: list[float]) -> str:
    """Return the ratio of the medians as text, with the range of the ratio over the pairs."""
    each = sorted(a / g for a, g in zip(attacked, golden, strict=True))
    middle = statistics.median(attacked) / statistics.median(golden)
    return f"{middle:.2f} ({each[0]:.2f} to {each[-1]:.2f})"


def row(node: str, seed: int, given: argparse.Namespace, out: str) -> str:
    """Measure one node and fault seed, and return a row of the table."""
    planner = node if node in PLANNERS else "rrtstar"
    plain = ["--world", given.world, "--seed", str(given.seed), "--planner", planner, "--out", out]
    plain += ["--stack", "hardened"]
    attacked = "planner" if node in PLANNERS else node
    mission = Path(out) / f"{node}.toml"
    mission.write_text(f'[instruction]\ntarget = "{attacked}"\nnull = {str(given.null).lower()}\n')
    fault = ["--config", str(mission), "--fault-seed", str(seed)]
    first = fly(*plain, *fault)
    golden, attacked = fly_pairs(plain, plain + fault, given.pairs)
    wall = ([c.wall_s for c in attacked], [c.wall_s for c in golden])
    cpu = ([c.cpu_s for c in attacked], [c.cpu_s for c in golden])
    simulated_s = [c.result["simulated_s"] for c in (golden[0], attacked[0])]
    return (
        f"| {node} | {seed} | {statistics.median(wall[1]):.2f} | {statistics.median(wall[0]):.2f} "
        f"| {ratio(*wall)} | {ratio(*cpu)} | {simulated_s[0]:.1f}, {simulated_s[1]:.1f} "
        f"| {first.wall_s:.1f} |"
    )


def main() -> None:
    """Measure all nodes, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=7)
    parser.add_argument("--fault-seeds", type=int, default=1)
    parser.add_argument("--node", action="append", choices=NODES)
    parser.add_argument("--world", default="dense")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--null", action="store_true")
    given = parser.parse_args()
    print(f"{given.world}, seed {given.seed}, {given.pairs} pairs; target {LIMIT}")
    print("| node | fault seed | golden, s | with fault, s | ratio | processor time "
          "| simulated, s | first, s |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as out:
        for node in given.node or NODES:
            for seed in range(1, given.fault_seeds + 1):
                print(row(node, seed, given, out), flush=True)


if __name__ == "__main__":
    main()
