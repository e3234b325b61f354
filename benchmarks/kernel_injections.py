"""Measures instruction-level injections in our kernels: how many per hour, and where time goes.

    python benchmarks/kernel_injections.py [--runs 100] [--replays 50] [--kernel NAME ...]

Prints for each kernel the injections per hour and core (by the sum of the runs' durations,
including hangs; and with the preparation spread over 5,000 runs), the injections per hour of
processor time (of tracer, template and runs, which other programs on the machine affect less), the
shares of a run's time that go into process start, the golden computation and the rest, the stop
time, and how many of the replays were identical. Targets: 50,000 injections per hour for PID and
point cloud, 5,000 for OctoMap and RRT*; a median stop time under 0.2 ms, and a 99th percentile
under 1 ms; 1,000 identical replays over all kernels. `kernel_null.py` measures the cost of a null
injection.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.attack.campaign import Plan, one_processor, replay_runs, run_campaign
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.mission.kernel_inputs import kernel_targets
from mavfi_cli.spec.mission import MissionConfig


def starts(place: Any, runs: int = 4) -> tuple[float, float]:
    """Return the mean time to start a run, and the mean CPU time of its undisturbed call.

    Both are in seconds. A run has started when it is ready for its trigger.
    """
    ready, call = [], []
    for where in place.inputs * runs:
        begun = time.perf_counter()
        tracee = where.start()
        ready.append(time.perf_counter() - begun)
        while tracee.ended is None:
            tracee.resume()
        call.append(where.left().cpu_s)
    return float(np.mean(ready)), float(np.mean(call))


def used_s() -> float:
    """Return the processor time, s, of this process and its children, including ended ones."""
    spent_s = time.process_time()
    for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
        fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
        spent_s += sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return spent_s


def measure(plan: Plan, target: KernelTarget, folder: Path, replays: int) -> tuple[int, int]:
    """Print the figures of one kernel. Return the numbers of identical and of all replays."""
    used: list[float] = []  # from the first run's end on
    (runs,) = run_campaign(
        plan, [target], folder=folder,
        progress=lambda _, done: used.append(used_s()) if done else None,
    )  # fmt: skip
    name, records = target.name, runs.records
    run_s = np.array([entry["run_s"] for entry in records])
    stops = [entry["injection"].get("stop_s") for entry in records]
    stop_ms = 1e3 * np.array([stop for stop in stops if stop is not None])
    with one_processor(), closing(runs.target.open()) as place:
        ready_s, call_s = starts(place)
    hangs = sum(entry["outcome"] == "hang" for entry in records)
    mean_s = run_s.mean()
    spread_s = mean_s + runs.prepare_s / 5000
    cpu_s = (used[-1] - used[0]) / (len(used) - 1)
    rest = max(0.0, 1.0 - (ready_s + call_s) / mean_s)
    print(
        f"{name}: {3600 / mean_s:,.0f} injections per hour and core ({3600 / spread_s:,.0f} with "
        f"{runs.prepare_s:.0f} s of preparation over 5,000 runs), {3600 / cpu_s:,.0f} per hour of "
        f"processor time; {hangs} hangs"
    )
    print(
        f"  a run takes {1e3 * mean_s:.1f} ms: process start {ready_s / mean_s:.0%}, golden "
        f"computation {call_s / mean_s:.0%}, counting, following, hangs and the rest {rest:.0%}"
    )
    print(
        f"  stop: median {np.median(stop_ms):.3f} ms, 99th percentile "
        f"{np.percentile(stop_ms, 99):.3f} ms; CPU time of the call {1e3 * call_s:.2f} ms"
    )
    for number, profile in enumerate(runs.profiles):
        print(f"  input {number}: {profile.in_words()}")
    found = list(replay_runs(folder, (name,), replays)) if replays else []
    equal = sum(not replay.differs for replay in found)
    for replay in found:
        if replay.differs:
            print(f"  run {replay.run} differs in {', '.join(replay.differs)}")
    print(f"  replays: {equal} of {len(found)} identical", flush=True)
    return equal, len(found)


def main() -> None:
    """Measure all selected kernels, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--replays", type=int, default=50)
    parser.add_argument("--kernel", action="append", default=[])
    options = parser.parse_args()
    equal = total = 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        plan = Plan(runs=options.runs, seed=1)
        flight = MissionConfig(stack="hardened")
        for target in kernel_targets(catalogue.select(options.kernel), flight, folder):
            own = folder / target.kernel  # a folder of several kernels is one campaign
            own.mkdir()
            inputs = Path(shutil.copy(target.inputs, own))
            same, count = measure(plan, replace(target, inputs=inputs), own, options.replays)
            equal, total = equal + same, total + count
    print(f"all kernels: {equal} of {total} replays identical")


if __name__ == "__main__":
    main()
