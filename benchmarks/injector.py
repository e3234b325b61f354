"""Measures the cost of the instruction-level injector on a small kernel-like program.

    python benchmarks/injector.py [--runs 400]

Prints the injections per hour and core (including hangs, which cost most), the stop time (to halt
the target, and to read, flip, write and read back the operand), the cost of one counted execution
for each mechanism, and the times to profile the program and to start a traced run. Targets: 50,000
injections per hour and core for small kernels, a median stop time under 0.2 ms and a 99th
percentile under 1 ms.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mavfi_cli.attack.campaign import Plan, TargetRuns, run_campaign
from mavfi_cli.attack.program import OutputComparison, ProgramTarget
from mavfi_cli.attack.target import RunOutcome
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.spawn import Program
from mavfi_cli.fi.tracer.tracee import Mechanism

SOURCE = r"""
#include <stdio.h>
#include <stdlib.h>
/* A PID law with clipping on three axes, as many ticks as the argument says. */
static double clip(double x, double limit) { return x > limit ? limit : x < -limit ? -limit : x; }
__attribute__((noinline)) void tick(double *x, double *v, double *i, const double *goal) {
    for (int a = 0; a < 3; a++) {
        double e = goal[a] - x[a];
        i[a] = clip(i[a] + 0.02 * e, 1.0);
        double u = clip(1.2 * e + 0.1 * i[a] - 0.6 * v[a], 3.0);
        v[a] += 0.02 * u; x[a] += 0.02 * v[a];
    }
}
int main(int c, char **argv) {
    double x[3] = {0}, v[3] = {0}, i[3] = {0}, goal[3] = {30, 40, 5};
    int n = c > 1 ? atoi(argv[1]) : 50;
    for (int k = 0; k < n; k++) tick(x, v, i, goal);
    printf("%.17g %.17g %.17g\n", x[0], x[1], x[2]);
    return 0;
}
"""


def build(folder: Path) -> Path:
    """Compile the program, and return its path."""
    compiler = shutil.which("gcc")
    if compiler is None:
        raise SystemExit("error: gcc is not installed")
    source, program = folder / "pid.c", folder / "pid"
    source.write_text(SOURCE)
    subprocess.run([compiler, "-O2", "-o", str(program), str(source)], check=True)
    return program


def target_of(program: Path, ticks: int, mechanism: Mechanism | None = None) -> ProgramTarget:
    """Return the program as a target of the injector, with a number of ticks to compute."""
    return ProgramTarget(
        command=Program.of([str(program), str(ticks)]),
        comparison=OutputComparison(),
        mechanism=mechanism,
    )


def milliseconds(seconds: list[float]) -> str:
    """Return the median and the 99th percentile of some times as text, in milliseconds."""
    median, high = np.percentile(seconds, [50, 99]) * 1e3
    return f"median {median:.3f} ms, 99th percentile {high:.3f} ms"


def seconds_per_hit(program: Path, mechanism: Mechanism) -> float:
    """Return the time that a mechanism takes to count one execution, in seconds.

    It is the slope of the time to reach the k-th execution, over k.
    """
    place = target_of(program, 3000, mechanism).open()
    counts, took = [1, 500, 1000, 2000], []
    for count in counts:
        best = np.inf
        for _ in range(3):
            tracee = place.start()
            image = Image(tracee.pid)
            address = image.address(image.function("tick", [program.name]))
            start = time.perf_counter()
            reached = tracee.run_to(address, count)
            best = min(best, time.perf_counter() - start)
            assert reached
            tracee.kill()
        took.append(best)
    place.close()
    return float(np.polyfit(counts, took, 1)[0])


def starts(program: Path, runs: int = 40) -> tuple[list[float], list[float]]:
    """Return the times, in seconds, to start the traced program, and to run it without tracing.

    A traced start ends at the program's entry point.
    """
    place = target_of(program, 50).open()
    traced, plain = [], []
    for _ in range(runs):
        start = time.perf_counter()
        tracee = place.start()
        traced.append(time.perf_counter() - start)
        tracee.kill()
        start = time.perf_counter()
        subprocess.run([program, "50"], stdout=subprocess.DEVNULL, check=True)
        plain.append(time.perf_counter() - start)
    place.close()
    return traced, plain


def summarise(campaign: TargetRuns, say: Callable[[str], None]) -> None:
    """Pass the figures of a campaign to `say`, line by line."""
    records = campaign.records
    total = sum(entry["run_s"] for entry in records)
    quick = [e["run_s"] for e in records if e["outcome"] != RunOutcome.HANG.value]
    hangs = len(records) - len(quick)
    say(f"injections per hour and core: {3600 * len(records) / total:,.0f} in all")
    say(f"  without the {hangs} hangs: {3600 * len(quick) / sum(quick):,.0f}")
    say(f"  one run: {milliseconds([entry['run_s'] for entry in records])}")
    profile = campaign.profile
    if profile is not None:
        say(f"  profile: {profile.executed} instructions in scope, {profile.cost_s:.2f} s, once")
    stops = [entry["injection"].get("stop_s") for entry in records]
    say(f"stop: {milliseconds([stop for stop in stops if stop is not None])}")
    hits = [sum(stage["count"] for stage in entry["trigger"]) for entry in records]
    say(f"counted executions a run: mean {np.mean(hits):.0f}, most {max(hits)}")


def main() -> None:
    """Run all measurements, and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=400)
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        (campaign,) = run_campaign(Plan(runs=runs, seed=1), [target_of(program, 50)])
        summarise(campaign, print)
        for mechanism in Mechanism:
            cost = seconds_per_hit(program, mechanism)
            print(f"one counted execution by {mechanism.value}: {1e6 * cost:.1f} us")
        traced, plain = starts(program)
        print(f"start to the entry point, traced: {milliseconds(traced)}")
        print(f"the whole program, not traced: {milliseconds(plain)}")


if __name__ == "__main__":
    main()
