"""Measures the share of each package of the code in a mission's CPU time.

    python benchmarks/mission_rooms.py --missions 40

A timer of the process's own CPU time interrupts the flights. Each sample counts for the innermost
function of mavfi on the stack, so numpy and pymavlink count for the package that calls them.
Garbage of one flight is collected before the next, because a mission of a campaign has a process of
its own.
"""

from __future__ import annotations

import argparse
import collections
import gc
import signal
import tempfile
from pathlib import Path
from types import FrameType

import mavfi_cli as mavfi

ROOT = Path(__file__).resolve().parents[1]
PERIOD_S = 0.001


def room(frame: FrameType | None) -> str:
    """Return the package, two folders deep, of the innermost function of mavfi on the stack."""
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in ("mavfi_cli", "sitl"):
            return "/".join(path.relative_to(ROOT).parts[:2])
        frame = frame.f_back
    return "none"


def main() -> None:
    """Sample the flights, and print the share of each package."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=40)
    parser.add_argument("--world", default="dense")
    parser.add_argument("--stack", default="mavbench")
    given = parser.parse_args()
    counts: collections.Counter[str] = collections.Counter()
    signal.signal(signal.SIGPROF, lambda _, frame: counts.update([room(frame)]))
    with tempfile.TemporaryDirectory() as folder:
        setting = {"world": given.world, "stack": given.stack, "out": folder}
        mavfi.fly(seed=1, **setting)  # compiles and loads
        for seed in range(2, 2 + given.missions):
            gc.collect()
            signal.setitimer(signal.ITIMER_PROF, PERIOD_S, PERIOD_S)
            try:
                mavfi.fly(seed=seed, **setting)
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0.0)
    total = counts.total()
    print(f"{given.missions} missions in {given.world} on {given.stack}, {total} samples")
    for name, count in counts.most_common():
        print(f"{count / total:6.1%}  {name}")


if __name__ == "__main__":
    main()
