"""What an instruction-level fault costs a whole mission, node by node.

    python benchmarks/instruction_missions.py [--pairs 7] [--fault-seeds 1] [--node NAME ...]

For each attacked kernel (the planner three times) and fault seed: the first command, which draws
the fault and keeps its profile (the first of a mission also keeps its golden flight); then pairs of
whole commands in turn, the golden mission and the one with the fault. Printed are medians, their
ratio with the range over the pairs, the same for processor time, and how long the first took.
Target: at most 1.3 times the wall time. `--null` injects without the flip, so that both fly the
same flight; else a faulty flight that is longer or shorter shows in the ratio.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from typing import Any

LIMIT = 1.3
NODES = ("point_cloud", "octomap", "collision_check", "control", "rrtstar", "rrt", "rrtconnect")
PLANNERS = ("rrtstar", "rrt", "rrtconnect")
MAVFI = (sys.executable, "-m", "mavfi_cli")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """One command."""

    wall_s: float
    cpu_s: float  # of all its processes
    result: dict[str, Any]


def command(line: list[str]) -> Cost:
    """Run a mission to its end."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run = subprocess.run([*MAVFI, *line], capture_output=True, text=True, check=True)
    wall_s = time.perf_counter() - begun
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(wall_s=wall_s, cpu_s=cpu_s, result=json.loads(run.stdout))


def ratio(attacked: list[float], golden: list[float]) -> str:
    """Of the medians, and the range over the pairs."""
    each = sorted(a / g for a, g in zip(attacked, golden, strict=True))
    middle = statistics.median(attacked) / statistics.median(golden)
    return f"{middle:.2f} ({each[0]:.2f} to {each[-1]:.2f})"


def row(node: str, seed: int, given: argparse.Namespace, out: str) -> str:
    """One line of the table."""
    planner = node if node in PLANNERS else "rrtstar"
    plain = ["fly", "--world", given.world, "--seed", str(given.seed), "--planner", planner]
    plain += ["--out", out, "--no-picture", "--quiet", "--json"]
    fault = ["--level", "instruction", "--inject", "planner" if node in PLANNERS else node]
    fault += ["--fault-seed", str(seed)] + (["--null-injection"] if given.null else [])
    first = command(plain + fault)
    golden, attacked = [], []
    for _ in range(given.pairs):
        golden.append(command(plain))
        attacked.append(command(plain + fault))
    wall = ([c.wall_s for c in attacked], [c.wall_s for c in golden])
    cpu = ([c.cpu_s for c in attacked], [c.cpu_s for c in golden])
    simulated_s = [c.result["simulated_s"] for c in (golden[0], attacked[0])]
    return (
        f"| {node} | {seed} | {statistics.median(wall[1]):.2f} | {statistics.median(wall[0]):.2f} "
        f"| {ratio(*wall)} | {ratio(*cpu)} | {simulated_s[0]:.1f}, {simulated_s[1]:.1f} "
        f"| {first.wall_s:.1f} |"
    )


def main() -> None:
    """Measure and print a table."""
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
