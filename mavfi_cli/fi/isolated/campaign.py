"""A campaign on one program: golden run, profile, faults, runs, and what they amount to."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.fi.isolated.attack import Attacker
from mavfi_cli.fi.isolated.journal import Journal
from mavfi_cli.fi.isolated.outcome import Outcome, counted, shares, shares_to_json, signal_name
from mavfi_cli.fi.isolated.profile import TargetProfile, in_words
from mavfi_cli.fi.isolated.program import (
    Golden,
    ProgramTarget,
    ProgramVerdict,
    Workplace,
    golden_run,
    profile_program,
)
from mavfi_cli.fi.isolated.runs import (
    FaultPlan,
    Record,
    Workers,
    csv_table,
    draw_records,
    one_processor,
    run_records,
)
from mavfi_cli.fi.sampling import Rule

_COLUMNS = (
    "run outcome signal exit_code magnitude object offset symbol instruction k site role operand "
    "bits before after activation not_injected_reason stop_s run_s output_sha256"
)
CSV_COLUMNS = _COLUMNS.split()


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan(FaultPlan):
    """What a campaign on a program does."""

    target: ProgramTarget

    def context(self) -> dict[str, Any]:
        """What every record says of the target."""
        return {
            "program": list(self.target.command.argv),
            "scope": list(self.target.scope_objects),
            "function": self.target.function,
        }

    def to_json(self) -> dict[str, Any]:
        """What results depend on; how many runs there are is not part of it."""
        comparison = asdict(self.target.comparison)
        return FaultPlan.to_json(self) | self.context() | {"comparison": comparison}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bench:
    plan: Plan
    golden: Golden
    stream: tuple[str, ...] = ()

    def open(self) -> Attacker[ProgramVerdict]:
        """Attacks on the program, from this process."""
        return Workplace(self.plan.target).attacker(self.golden)


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """All runs of a plan, in order of their numbers."""

    plan: Plan
    golden: Golden
    profiled: TargetProfile | None  # None for time rules
    records: tuple[Record, ...]
    wall_s: float

    def summary(self) -> dict[str, Any]:
        """Counts, shares and intervals, with everything that the numbers depend on."""
        profile, records = self.profiled, self.records
        windows = [] if profile is None else [profile.window_of(entry) for entry in records]
        return {
            **self.plan.context(),
            "sampling": self.plan.strategy().name,
            "seed": self.plan.seed,
            "runs": len(records),
            "executed_in_scope": None if profile is None else profile.executed,
            "profile_complete": None if profile is None else profile.complete,
            "windows": None if profile is None else profile.windows,
            "profile_s": None if profile is None else profile.cost_s,
            "golden_wall_s": self.golden.wall_s,
            "wall_s": self.wall_s,
            "outcomes": shares_to_json(
                shares((Outcome(entry["outcome"]) for entry in records), windows)
            ),
            "crashes": counted(
                signal_name(entry["signal"]) if entry["signal"] else f"exit {entry['exit_code']}"
                for entry in records
                if entry["outcome"] == Outcome.CRASH.value
            ),
            "not_injected": counted(
                entry["not_injected_reason"] for entry in records if entry["not_injected_reason"]
            ),
            "activation": counted(entry["activation"]["activation"] for entry in records),
        }


def run_campaign(
    plan: Plan,
    *,
    jobs: int = 1,
    folder: Path | None = None,
    progress: Callable[[int], None] | None = None,
    stage: Callable[[str], None] = lambda _: None,
) -> Campaign:
    """Golden run, profile, fault list, runs.

    Args:
        plan: what to do.
        jobs: worker processes.
        folder: where the faults are flushed before the first one runs, and every run after it;
            the runs that it has already are not repeated.
        progress: called with the number of runs that are there.
        stage: called with what goes on before the first run.

    Raises:
        TracingForbidden: the operating system refuses.
        TargetError: the program cannot be attacked; says why.
        ConfigError: the folder holds another campaign, or runs that this one leaves out.
    """
    start = time.perf_counter()
    journal = None if folder is None else Journal(folder, plan.to_json(), runs=plan.runs)
    with one_processor():
        golden, profiled = _prepare(plan, stage)
    bench = _Bench(plan=plan, golden=golden)
    stage(f"drawing {plan.runs} faults")
    planned = draw_records(bench, profiled, plan.context())
    with Workers(jobs) as workers:
        records = run_records(bench, planned, workers, journal=journal, progress=progress)
    return Campaign(
        plan=plan,
        golden=golden,
        profiled=profiled,
        records=records,
        wall_s=time.perf_counter() - start,
    )


def _prepare(plan: Plan, stage: Callable[[str], None]) -> tuple[Golden, TargetProfile | None]:
    place = Workplace(plan.target)
    try:
        stage("golden runs")
        golden = golden_run(place)
        if plan.strategy().rule is not Rule.INSTRUCTION:
            return golden, None
        rng = generator(plan.seed, Stream.FAULT, "profile")
        stage("profile")
        profiled = profile_program(place, rng, windows=plan.windows, watch=in_words(stage))
        return golden, profiled
    finally:
        place.close()


def csv_rows(campaign: Campaign) -> Iterator[list[str]]:
    """Header and one row a run."""
    return csv_table(CSV_COLUMNS, campaign.records)


def to_json(campaign: Campaign) -> dict[str, Any]:
    """Summary, golden run and all records."""
    golden = asdict(campaign.golden)
    golden.pop("output")
    return {
        "summary": campaign.summary(),
        "golden": golden,
        "runs": list(campaign.records),
    }
