"""Measures what a null injection costs a kernel outside its counted window, in paired runs.

    python benchmarks/kernel_null.py [--rounds 300] [--kernel NAME ...]

Every round runs the same call from the same memory once in each of these ways, and every second
round runs them in the opposite order:

    free      not traced
    ended     traced, with nothing armed: the counted window was over before the call
    armed     traced, with a counter armed that counts nothing: the window has not begun yet
    counted   traced, with every entry into the kernel counted by a breakpoint: in the window
    detoured  traced, with every entry counted by a detour, if a detour fits there
    stopped   stopped at the first entry for a null injection, then not traced
    after     stopped at the first entry for a null injection, then traced to the end

Outside the window, a null injection costs `armed` over `free` before the window, and `after` over
`stopped` after it. `ended` over `free` is the cost of tracing alone, and `detoured` over `free` is
the cost of counting all entries up to a late one. Each cost is the median over all rounds of the
ratio of the call's CPU times within a round, with a 95 % bootstrap interval. Target: less than 1 %.
The cost of the window itself is printed as well: that of the stop (`stopped` minus `free`), and
that of one execution that a breakpoint counts (`counted` minus `armed`, divided by the entries).
"""

from __future__ import annotations

import argparse
import os
import select
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.attack.campaign import one_processor
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.attack.profile import count_markers
from mavfi_cli.fi.tracer.counted import Detour
from mavfi_cli.fi.tracer.inject import instruction_at
from mavfi_cli.fi.tracer.tracee import ExecutionCounter, Tracee
from mavfi_cli.mission.kernel_inputs import kernel_targets
from mavfi_cli.spec.mission import MissionConfig

WAYS = ("free", "ended", "armed", "counted", "detoured", "stopped", "after")
PAIRS = (("ended", "free"), ("armed", "free"), ("detoured", "free"), ("after", "stopped"))
NEVER = 1 << 40  # more executions than any call has
NOWHERE = 0x1000  # nothing is mapped there


def finish(tracee: Tracee) -> None:
    """Run a traced process to its end."""
    while tracee.ended is None:
        tracee.resume()


def finish_alone(tracee: Tracee) -> None:
    """Detach from a traced process, and wait for its end."""
    process = os.pidfd_open(tracee.pid)
    try:
        tracee.detach()
        select.select([process], [], [])
    finally:
        os.close(process)


def run(place: Any, way: str, detour: Detour | None) -> float:
    """Run one call in one of the ways. Return the call's CPU time in seconds."""
    tracee = place.start()
    entry = place.image(tracee).address(place.kernel_scope.entry)
    if way in ("armed", "counted"):
        counter = ExecutionCounter(tracee.tid, NOWHERE if way == "armed" else entry, NEVER)
        finish(tracee)
        counter.close()
    elif way == "detoured":
        assert not tracee.run_to(entry, NEVER, detour)
    elif way in ("stopped", "after"):
        assert tracee.run_to(entry), "the kernel is never entered"
        assert instruction_at(tracee, entry) is not None
        (finish if way == "after" else finish_alone)(tracee)
    else:
        (finish if way == "ended" else finish_alone)(tracee)
    told = place.left()
    assert told is not None
    return told.cpu_s


def ratio(over: np.ndarray, under: np.ndarray) -> str:
    """Return the median of paired ratios minus 1 as text, with its 95 % bootstrap interval."""
    pairs = over / under - 1.0
    rng = np.random.default_rng(1)
    medians = np.median(rng.choice(pairs, (4000, len(pairs))), axis=1)
    low, high = np.percentile(medians, [2.5, 97.5])
    return f"{np.median(pairs):+.2%} ({low:+.2%} to {high:+.2%})"


def measure(name: str, inputs: Path, rounds: int) -> None:
    """Measure one kernel in all ways, and print its row of the table."""
    target = KernelTarget(kernel=name, inputs=inputs)
    with one_processor(), closing(target.open()) as place:
        ((entries, detour),) = count_markers(place, [place.kernel_scope.entry])
        spent: dict[str, list[float]] = {way: [] for way in WAYS}
        for number in range(rounds):
            for way in WAYS if number % 2 else reversed(WAYS):
                spent[way].append(run(place, way, detour))
    cpu_s = {way: np.array(values) for way, values in spent.items()}
    cells = [ratio(cpu_s[over], cpu_s[under]) for over, under in PAIRS]
    stop_us = 1e6 * np.median(cpu_s["stopped"] - cpu_s["free"])
    hit_us = 1e6 * np.median(cpu_s["counted"] - cpu_s["armed"]) / entries
    print(
        f"| {name} | {1e3 * np.median(cpu_s['free']):.2f} | {' | '.join(cells)} "
        f"| {stop_us:.0f} | {hit_us:.0f} ({entries}) |",
        flush=True,
    )


def main() -> None:
    """Measure all selected kernels, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--kernel", action="append", default=[])
    options = parser.parse_args()
    print(
        "| kernel | call, ms | tracing alone | before the window | counted by a detour "
        "| after it | the stop, us "
        "| a counted execution, us (entries) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        names, flight = catalogue.select(options.kernel), MissionConfig(stack="hardened")
        for target in kernel_targets(names, flight, Path(scratch)):
            measure(target.kernel, target.inputs, options.rounds)


if __name__ == "__main__":
    main()
