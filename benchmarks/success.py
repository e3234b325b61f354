"""Measures the success rates of golden missions: 100 seeds per world, with Wilson intervals.

Prints the table of docs/results/speed.md:

    python benchmarks/success.py [--seeds 100] [--jobs 2] [--world dense ...] [--stack mavbench]
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from missions import fly
from scipy.stats import binomtest

WORLDS = ("farm", "factory", "sparse", "dense")
REQUIRED = {"farm": 0.99, "factory": 0.99, "sparse": 0.95, "dense": 0.85}


def outcome_of(world: str, seed: int, given: argparse.Namespace, out: str) -> dict[str, Any]:
    """Fly one golden mission, and return its record."""
    line = ["--world", world, "--seed", str(seed), "--planner", given.planner]
    line += ["--stack", given.stack, "--out", out]
    return fly(*line).result


def row(world: str, results: list[dict[str, Any]]) -> str:
    """Return the row of the table for a world, from the records of its missions."""
    outcomes = Counter(result["outcome"] for result in results)
    wins, n = outcomes["success"], len(results)
    low, high = binomtest(wins, n).proportion_ci(method="wilson")
    flown = [r for r in results if r["outcome"] == "success"]

    def median(*path: str) -> float:
        """Return the median over successful flights of a number in result.json.

        `path` has the keys of the number. The median is NaN if no flight succeeded.
        """
        values = []
        for result in flown:
            value: Any = result
            for key in path:
                value = value[key]
            values.append(value)
        return statistics.median(values) if values else float("nan")

    failures = ", ".join(f"{k} {v}" for k, v in sorted(outcomes.items()) if k != "success")
    return (
        f"| {world} | {wins}/{n} | {100 * low:.1f} to {100 * high:.1f} % | "
        f"{100 * REQUIRED[world]:.0f} % | {median('quality_of_flight', 'flight_time_s'):.1f} s | "
        f"{median('quality_of_flight', 'distance_m'):.1f} m | "
        f"{median('quality_of_flight', 'energy_regression_j') / 1e3:.1f} kJ | "
        f"{statistics.fmean(r['pilot']['replans'] for r in results):.2f} | "
        f"{failures or 'none'} |"
    )


def main() -> None:
    """Fly the missions of all selected worlds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--planner", default="rrtstar")
    parser.add_argument("--stack", default="mavbench")
    parser.add_argument("--world", action="append", choices=WORLDS)
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.seeds)
    print(f"Golden missions, seeds {seeds[0]} to {seeds[-1]}, planner {given.planner}, "
          f"stack {given.stack}\n")  # fmt: skip
    print("| world | success | Wilson 95 % | required | time | distance | energy | replans "
          "(mean) | failures |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        for world in given.world or WORLDS:
            flights = [pool.submit(outcome_of, world, s, given, folder) for s in seeds]
            results = [flight.result() for flight in flights]
            print(row(world, results), flush=True)
            lost = [r["config"]["seed"] for r in results if r["outcome"] != "success"]
            if lost:
                print(f"  {world}: not successful with seeds {lost}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
