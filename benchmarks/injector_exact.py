"""Checks that the injector is exact: predicted outputs, drawn instructions, flipped bits.

    python benchmarks/injector_exact.py [--faults 2000] [--draws 20000] [--kernel NAME ...]

1. A program that computes with a register in each of 500 rounds: the fault strikes the register at
   a drawn execution, and the output is predicted in Python. Every prediction must be met.
2. For each kernel that is profiled whole: the executions of every instruction are counted again, by
   hardware breakpoints that run freely (no single-stepping). Chi-square of the drawn instructions
   against these counts; the p-values must look uniform.
3. For each kernel that is profiled by windows: the executions of some instructions are counted in
   the same way, and lie in the 95 % interval of the estimate as often as it says.
4. In runs of each kernel: the register after the flip differs from the one before in exactly the
   planned bits, read back from the stopped process.
5. The same faults again, where a detour counted: breakpoints alone reach the same execution, with
   the same registers, activation, outcome and output.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from mavfi_cli.attack.attacker import Attacker, golden_run
from mavfi_cli.attack.campaign import Plan, Record, one_processor, run_campaign
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.attack.profile import TargetProfile
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import (
    FaultModel,
    InstructionCorruption,
    InstructionFault,
    Role,
    Site,
    Strategy,
)
from mavfi_cli.fi.tracer.spawn import Program
from mavfi_cli.mission.kernel_inputs import inputs_of_flight
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.shares import estimated_total

ROUNDS, FACTOR, WORD = 500, 6364136223846793005, 1 << 64
SOURCE = f"""
#include <stdio.h>
__attribute__((noinline)) unsigned long take(unsigned long x) {{
    unsigned long r;
    __asm__ volatile("mov %1, %%r10; mov %%r10, %0" : "=r"(r) : "r"(x) : "r10");
    return r;
}}
int main(void) {{
    unsigned long sum = 1;
    for (unsigned long i = 0; i < {ROUNDS}; i++) sum = {FACTOR}ul * sum + take(i);
    printf("%lu\\n", sum);
    return 0;
}}
"""
RESUME_FLAG = 1 << 16
MOST_HITS = 20_000  # of an instruction whose executions are counted one by one


def predicted(execution: int, bit: int) -> str:
    """Return what the program prints if a bit is flipped in one round. Rounds count from 1."""
    total = 1
    for number in range(ROUNDS):
        taken = number ^ (1 << bit) if number + 1 == execution else number
        total = (FACTOR * total + taken) % WORD
    return f"{total}\n"


def exact_stops(faults: int, rng: np.random.Generator) -> tuple[int, int]:
    """Inject faults into random executions of one instruction, and compare the program's output.

    Return the number of outputs that were as predicted, and the number of faults.
    """
    compiler = shutil.which("gcc")
    if compiler is None:
        raise SystemExit("error: gcc is not installed")
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder) / "taken.c", Path(folder) / "taken"
        source.write_text(SOURCE)
        subprocess.run([compiler, "-O1", "-o", str(program), str(source)], check=True)
        command = Program.of([str(program)])
        target = ProgramTarget(command=command, comparison=OutputComparison(), function="take")
        with one_processor(), closing(target.open()) as place:
            attacker = Attacker(place=place, golden=golden_run(place))
            fault = taken_fault(place.profile(rng, windows=1))
            met = 0
            for _ in range(faults):
                execution, bit = int(rng.integers(1, ROUNDS + 1)), int(rng.integers(64))
                result = attacker.run(fault(execution, bit))
                expected = hashlib.sha256(predicted(execution, bit).encode()).hexdigest()
                met += result.verdict.output_sha256 == expected
    return met, faults


def taken_fault(profile: TargetProfile):
    """Return a function that makes a fault in the register that `take` sets.

    The function takes the number of the execution and the bit to flip.
    """
    (segment,) = profile.strata[0].segments
    for address in map(int, segment.trace):
        instruction = decode(profile.code_at(address), address)
        if instruction.text.startswith("mov r10,"):
            break

    def fault(execution: int, bit: int) -> InstructionFault:
        return InstructionFault(
            trigger=(CountedStop(profile.image.locate(address), execution),),
            execution=execution,
            instruction=instruction.text,
            instruction_bytes=instruction.raw,
            corruption=InstructionCorruption(
                site=Site.GENERAL,
                role=Role.DESTINATION,
                register="r10",
                operand="r10",
                bits=(bit,),
            ),
        )

    return fault


def counted(place: Any, address: int) -> int:
    """Return how often an instruction executes in one undisturbed run."""
    tracee = place.start()
    try:
        return tracee.count_to_end(address)[0]
    finally:
        tracee.kill()


def chi_square(place: Any, profile: TargetProfile, draws: int, rng: np.random.Generator) -> str:
    """Return a chi-square test, as text, of drawn instructions against counted executions.

    The executions are counted in runs that are not single-stepped.
    """
    addresses = sorted({int(each) for each in profile.strata[0].segments[0].trace})
    counts = np.array([counted(place, address) for address in addresses])
    plan = Strategy.of("instruction-uniform", FaultModel(sites=frozenset((Site.OPCODE,))))
    drawn = Counter(profile.image.address(profile.draw(plan, rng).target) for _ in range(draws))
    observed = np.array([drawn[address] for address in addresses], float)
    expected = counts * draws / counts.sum()
    enough = expected >= 5.0
    observed = np.append(observed[enough], observed[~enough].sum())
    expected = np.append(expected[enough], expected[~enough].sum())
    observed, expected = observed[expected > 0], expected[expected > 0]
    value = float(((observed - expected) ** 2 / expected).sum())
    return (
        f"{counts.sum()} executions of {len(addresses)} instructions counted, {profile.executed} "
        f"stepped; {draws} draws: chi-square {value:.0f} with {len(observed) - 1} degrees, "
        f"p = {chi2.sf(value, len(observed) - 1):.2f}"
    )


def estimates(place: Any, profile: TargetProfile, number: int, rng: np.random.Generator) -> str:
    """Compare the counts of sampled instructions with their estimates. Return a line of text.

    The line says how many counts are within the interval of the estimate.
    """
    traces = [[segment.trace for segment in stratum.segments] for stratum in profile.strata]
    addresses = np.unique(np.concatenate([trace for some in traces for trace in some]))
    inside, ratios = 0, []
    for address in rng.permutation(addresses).tolist():
        found = estimated_total(
            [
                ([float(np.count_nonzero(trace == address)) for trace in some], all_.windows_in_run)
                for some, all_ in zip(traces, profile.strata, strict=True)
            ]
        )
        if found.low == found.high or found.value > MOST_HITS:
            continue
        count = counted(place, address)
        inside += found.low <= count <= found.high
        ratios.append(count / found.value)
        if len(ratios) == number:
            break
    return (
        f"{inside} of {len(ratios)} counts in the 95 % interval of the estimate, count over "
        f"estimate {np.mean(ratios):.3f}"
    )


def planned_bits(records: Sequence[Record]) -> tuple[int, int]:
    """Return in how many applied flips exactly the planned bits changed, and how many there are."""
    exact = applied = 0
    for entry in records:
        injection = entry["injection"]
        if injection.get("applied"):
            changed = int(injection["before"], 16) ^ int(injection["after"], 16)
            applied += 1
            exact += changed == sum(1 << bit for bit in entry["corruption"]["bits"])
    return exact, applied


def same_by_breakpoints(target: KernelTarget, records: Sequence[Record]) -> tuple[int, int]:
    """Repeat, without a detour, the runs in which a detour counted executions.

    Return how many of these runs are the same, and how many there are.
    """
    detoured = [entry for entry in records if any("detour" in stage for stage in entry["trigger"])]
    same = 0
    with one_processor(), closing(target.open()) as place:
        attackers = [Attacker(place=each, golden=golden_run(each)) for each in place.inputs]
        for entry in detoured:
            fault = record.fault_of(entry)
            stages = tuple(replace(stage, detour=None) for stage in fault.trigger)
            again = attackers[entry["input"]].run(replace(fault, trigger=stages))
            same += seen(again.completed(entry)) == seen(entry)
    return same, len(detoured)


def seen(entry: Record) -> list[Any]:
    """Return the values of a record to compare.

    The flag that a breakpoint leaves in rflags is cleared.
    """
    injection = entry["injection"]
    values = [int(injection.get(key, "0"), 16) & ~RESUME_FLAG for key in ("before", "after")]
    return values + [entry[key] for key in ("outcome", "signal", "output_sha256", "activation")]


def main() -> None:
    """Run all checks, and print their results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=2000)
    parser.add_argument("--draws", type=int, default=20_000)
    parser.add_argument("--kernel", action="append", default=[])
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    met, faults = exact_stops(options.faults, rng)
    print(f"exact stops: {met} of {faults} predicted outputs", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        fed = inputs_of_flight(MissionConfig(stack="hardened"), Path(scratch))
        all_exact = all_applied = all_same = all_detoured = 0
        for kernel in catalogue.select(options.kernel):
            target = KernelTarget(kernel=kernel, **fed)
            with one_processor(), closing(target.open()) as place:
                for number, where in enumerate(place.inputs):
                    profile = where.profile(rng, windows=16)
                    if profile.complete:
                        said = chi_square(where, profile, options.draws, rng)
                    else:
                        said = estimates(where, profile, 20, rng)
                    print(f"{kernel}, input {number}: {said}", flush=True)
            (campaign,) = run_campaign(Plan(runs=options.faults // 7, seed=1), [target])
            exact, applied = planned_bits(campaign.records)
            all_exact, all_applied = all_exact + exact, all_applied + applied
            same, detoured = same_by_breakpoints(target, campaign.records)
            all_same, all_detoured = all_same + same, all_detoured + detoured
    print(f"exactly the planned bits: {all_exact} of {all_applied} flips")
    print(f"the same by breakpoints: {all_same} of {all_detoured} runs")


if __name__ == "__main__":
    main()
