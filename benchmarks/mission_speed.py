"""Measures the speed of a golden mission, in times real time, and where the host's time goes.

Prints the tables of docs/results/speed.md:

    python benchmarks/mission_speed.py [--runs 7] [--world dense] [--seed 3] [--stack mavbench]

`wait` is the time in which companion or vehicle waits for the other and to be woken. The two waits
overlap.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from typing import Any

from missions import fly


def stages(title: str, results: list[dict[str, Any]], key: str) -> None:
    """Print a table of the median host time of each stage, in ms per simulated second."""
    simulated_s = results[0]["simulated_s"]
    print(f"\n| {title} | ms a simulated second |\n|---|---|")
    names = sorted({name for r in results for name in r["host"][key]})
    rows = [
        (statistics.median(r["host"][key].get(name, 0.0) for r in results), name) for name in names
    ]
    for seconds, name in sorted(rows, reverse=True):
        print(f"| {name} | {1e3 * seconds / simulated_s:.2f} |")


def main() -> None:
    """Fly the missions, and print medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--world", default="dense")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--stack", default="mavbench")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as out:
        line = ["--world", given.world, "--seed", str(given.seed)]
        line += ["--stack", given.stack, "--out", out]
        fly(*line)  # warms the caches
        results = [fly(*line).result for _ in range(given.runs)]
    factors = sorted(r["simulated_s"] / r["host"]["flight_wall_s"] for r in results)
    startups = [r["host"]["startup_s"] for r in results]
    # companion and vehicle share one process in lockstep, so both sides report its memory
    memory_mb = max(max(r["host"]["memory_mb"].values()) for r in results)
    print(f"{given.world}, seed {given.seed}, stack {given.stack}: "
          f"{results[0]['simulated_s']:.1f} simulated seconds, {given.runs} runs")  # fmt: skip
    print(f"times real time: median {statistics.median(factors):.1f} "
          f"({factors[0]:.1f} to {factors[-1]:.1f})")  # fmt: skip
    print(f"start-up to first heartbeat: median {statistics.median(startups):.2f} s")
    print(f"peak memory: {memory_mb:.0f} MB")
    stages("companion", results, "stage_wall_s")
    stages("vehicle", results, "vehicle_stage_wall_s")


if __name__ == "__main__":
    main()
