"""Measures the missions per hour of a campaign, and the share of time spent outside missions.

    python benchmarks/campaign.py [--missions 100] [--jobs 2 ...] [--world sparse]

Flies golden missions, each with `--faults` missions that have a source-level fault, and then the
same number of missions with an instruction-level fault. Repeats both for every number of jobs.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Progress, Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

STACK = "hardened"  # of the figures in docs/results/speed.md
STAGES = ("perception", "planning", "control")
REQUIRED = {"golden and source level": 1000.0, "instruction level": 700.0}
OUTSIDE_LIMIT = 0.05


class _Last(Spectator):
    """A spectator that keeps the newest progress of a campaign."""

    progress: Progress

    def on_progress(self, progress: Progress) -> None:
        """Replace the kept progress by the newest."""
        self.progress = progress


def source_missions(world: str, count: int, faults: int) -> list[PlannedMission]:
    """Return golden missions, each followed by `faults` missions with a source-level fault."""
    found = []
    for seed in range(1, count // (1 + faults) + 1):
        golden = MissionConfig(world=world, seed=seed, stack=STACK)
        found.append(PlannedMission(config=golden))
        for number in range(faults):
            fault = FaultConfig(target=STAGES[(seed + number) % 3], seed=seed)
            found.append(PlannedMission(config=replace(golden, fault=fault)))
    return found


def instruction_missions(world: str, count: int) -> list[PlannedMission]:
    """Return missions with an instruction-level fault, in each stage in turn.

    As in the paper's Table IV, the stages get their faults in the same missions.
    """
    return [
        PlannedMission(
            config=MissionConfig(
                world=world, seed=1 + index // 9, stack=STACK,
                instruction=InstructionConfig(target=STAGES[index % 3], seed=index),
            )
        )
        for index in range(count)
    ]  # fmt: skip


def row(name: str, missions: Sequence[PlannedMission], jobs: int) -> str:
    """Fly the missions with a number of jobs, and return their row of the table."""
    last = _Last()
    with tempfile.TemporaryDirectory() as folder:
        options = Options(jobs=jobs, keep=Keep.NONE)
        with run_campaign(missions, Path(folder) / "campaign", options, last) as ledger:
            errors = sum(result.outcome is None for result in ledger.results())
    seen = last.progress
    outside = 1.0 - seen.inside_s / (jobs * seen.elapsed_s)
    return (
        f"| {name} | {jobs} | {len(missions)} | {seen.rate_per_h:.0f} | "
        f"{REQUIRED[name]:.0f} | {100 * outside:.1f} % | {100 * OUTSIDE_LIMIT:.0f} % | {errors} |"
    )


def main() -> None:
    """Fly all missions, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--missions", type=int, default=100)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, os.cpu_count() or 1])
    parser.add_argument("--world", default="sparse")
    parser.add_argument("--faults", type=int, default=1, help="faulty missions a golden one")
    given = parser.parse_args()
    print(
        "| missions | jobs | flown | an hour | required (2 cores) | outside missions | at most "
        "| could not begin |\n|---|---|---|---|---|---|---|---|"
    )
    lists = {
        "golden and source level": source_missions(given.world, given.missions, given.faults),
        "instruction level": instruction_missions(given.world, given.missions),
    }
    for name, missions in lists.items():
        for jobs in given.jobs:
            print(row(name, missions, jobs), flush=True)


if __name__ == "__main__":
    main()
