"""Measures the time of `mavfi vpm`, with and without pictures, in fresh processes with warm caches.

python benchmarks/performance_model.py [--runs 11]
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import tempfile
import time

from missions import MAVFI

LIMIT_S = 2.0


def run_s(*options: str) -> float:
    """Return the wall time of one `mavfi vpm` with some options, in seconds."""
    begun = time.perf_counter()
    line = [*MAVFI, "vpm", *options]
    subprocess.run(line, capture_output=True, check=True)
    return time.perf_counter() - begun


def main() -> None:
    """Measure both, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=11)
    runs = parser.parse_args().runs
    print("| what | median | range | required |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, options in (("`mavfi vpm`", ()), ("with pictures", ("--out", folder))):
            run_s(*options)  # fills the caches
            times = sorted(run_s(*options) for _ in range(runs))
            print(
                f"| {name} | {statistics.median(times):.2f} s | {times[0]:.2f} to "
                f"{times[-1]:.2f} s | {LIMIT_S:g} s |",
                flush=True,
            )


if __name__ == "__main__":
    main()
