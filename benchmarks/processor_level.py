"""Measures the cost of kernels compiled for x86-64-v3 instead of for this processor.

Flies golden missions in turn with both kinds of kernels, and prints a table:

    python benchmarks/processor_level.py [--runs 9] [--world dense] [--stack hardened]
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
from pathlib import Path

from missions import Flown, fly

from mavfi_cli.core.compiled import TARGET, processor_level

_LEVELS = {TARGET: TARGET, "this processor": "host"}  # values of NUMBA_CPU_NAME


def main() -> None:
    """Fly both kinds in turn, and print medians and the median ratio of neighbouring flights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--world", default="dense")
    parser.add_argument("--stack", default="hardened")
    given = parser.parse_args()
    flown: dict[str, list[Flown]] = {level: [] for level in _LEVELS}
    with tempfile.TemporaryDirectory() as folder:
        line = ["--world", given.world, "--stack", given.stack, "--out", f"{folder}/run"]
        for run in range(1 + given.runs):  # the first of each compiles the kernels
            for level, name in _LEVELS.items():
                os.environ["NUMBA_CPU_NAME"] = name
                os.environ["NUMBA_CACHE_DIR"] = str(Path(folder, name))
                mission = fly(*line)
                if run:
                    flown[level].append(mission)
    print(f"{given.world}, stack {given.stack}, on a processor of {processor_level()}:\n")
    print("| kernels compiled for | missions | CPU time of a mission, median | range |")
    print("|---|---|---|---|")
    for level, missions in flown.items():
        times = sorted(mission.cpu_s for mission in missions)
        print(f"| {level} | {len(times)} | {statistics.median(times):.2f} s "
              f"| {times[0]:.2f} to {times[-1]:.2f} s |")  # fmt: skip
    ratios = [one.cpu_s / other.cpu_s for one, other in zip(*flown.values(), strict=True)]
    print(f"\nmedian ratio of neighbouring missions: {statistics.median(ratios):.3f}")


if __name__ == "__main__":
    main()
