"""Measures the wait for `mavfi --help`, and from `mavfi fly` to the first control tick.

Prints medians over fresh processes with warm caches:

    python benchmarks/startup.py [--runs 11]
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable

from missions import MAVFI

HELP_LIMIT_S, TICK_LIMIT_S = 0.3, 3.0
FIRST_TICK = "waiting until ready"  # what the first control tick makes the mission say


def help_s() -> float:
    """Return the wall time of `mavfi --help`, in seconds."""
    begun = time.perf_counter()
    subprocess.run([*MAVFI, "--help"], capture_output=True, check=True)
    return time.perf_counter() - begun


def first_tick_s() -> float:
    """Return the wall time from the start of `mavfi fly` to its first control tick, in seconds."""
    with tempfile.TemporaryDirectory() as folder:
        line = [*MAVFI, "fly", "--stack", "hardened", "--world", "dense", "--time-limit", "1",
                "--no-picture"]  # fmt: skip
        begun = time.perf_counter()
        with subprocess.Popen(
            [*line, "--out", folder], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as process:
            assert process.stderr is not None
            for said in process.stderr:
                if FIRST_TICK in said:
                    waited_s = time.perf_counter() - begun
                    process.communicate()
                    return waited_s
    raise SystemExit("cannot measure the start-up: the mission ended before its first control tick")


def row(name: str, limit_s: float, measure: Callable[[], float], runs: int) -> str:
    """Measure `runs` times, and return a row of the table with median, range and limit."""
    measure()  # fills the caches
    times = sorted(measure() for _ in range(runs))
    return (
        f"| {name} | {statistics.median(times):.3f} s | {times[0]:.3f} to {times[-1]:.3f} s | "
        f"{limit_s:g} s |"
    )


def main() -> None:
    """Measure both waits, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=11)
    runs = parser.parse_args().runs
    print("| what | median | range | required |\n|---|---|---|---|")
    print(row("`mavfi --help`", HELP_LIMIT_S, help_s, runs), flush=True)
    print(row("`mavfi fly`, start-up to first tick", TICK_LIMIT_S, first_tick_s, runs))


if __name__ == "__main__":
    main()
