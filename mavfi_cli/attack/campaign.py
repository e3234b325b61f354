"""Runs many faults on each of several targets: golden run, profile, fault list, runs.

Fault number i of a target depends on the seed, the target's own stream and i only. So the results
depend neither on the number of workers nor on the other targets.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mavfi_cli.attack.attacker import Attacker, RunResult, golden_run
from mavfi_cli.attack.journal import Journal
from mavfi_cli.attack.plan import Plan
from mavfi_cli.attack.profile import TargetProfile, steps_told
from mavfi_cli.attack.target import AttackTarget, Golden, JudgedPlace
from mavfi_cli.attack.workers import AttackWorkers, Bench, one_processor
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.sampling import Rule

Record = dict[str, Any]
Progress = Callable[[str, int], None]
Stage = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetRuns:
    """All runs of one target, in order of their numbers, with the profile they were drawn from."""

    target: AttackTarget
    context: Mapping[str, Any]  # entries of every record about the target
    golden: Golden
    profile: TargetProfile | None  # None for time rules
    records: tuple[Record, ...] = ()
    prepare_s: float
    wall_s: float = 0.0


def run_campaign(
    plan: Plan,
    targets: Sequence[AttackTarget],
    *,
    jobs: int = 1,
    folder: Path | None = None,
    progress: Progress = lambda _name, _done: None,
    stage: Stage = lambda _: None,
) -> list[TargetRuns]:
    """Make golden run, profile, fault list and runs of every target.

    Args:
        plan: which faults are drawn, and how.
        targets: one or more; if there are several, each has its own stream.
        jobs: worker processes.
        folder: the faults are flushed there before the first run, and each run when it is over.
            Runs that are already there are not repeated.
        progress: called with the target and the number of its completed runs; with 0 before its
            golden run and profile.
        stage: called with the present step before a target's first run.

    Raises:
        TracingForbidden: the operating system refuses.
        TargetError: a target cannot be attacked; says why.
        ConfigError: the folder holds another campaign, or runs beyond this one.
    """
    journal = None
    if folder is not None:
        names = [target.stream[0] for target in targets if target.stream]
        journal = Journal(folder, plan.to_json(targets[0]), runs=plan.runs, kernels=names or None)
    with AttackWorkers(jobs) as workers:
        return [_attack(plan, each, workers, journal, progress, stage) for each in targets]


def _attack(
    plan: Plan,
    target: AttackTarget,
    workers: AttackWorkers,
    journal: Journal | None,
    progress: Progress,
    stage: Stage,
) -> TargetRuns:
    begun = time.perf_counter()
    progress(target.name, 0)
    with one_processor():
        prepared, place = _prepare(plan, target, stage)
    stage(f"drawing {plan.runs} faults")
    bench = Bench(plan=plan, target=prepared.target, golden=prepared.golden)
    workers.take(bench, Attacker(place=place, golden=prepared.golden))
    planned = _draw(plan, bench, prepared)
    done: dict[int, Record] = {}
    if journal is not None:
        done = journal.runs_of(planned)
        journal.flush_plan("-".join(("faults", *target.stream)) + ".jsonl", planned)
    for index, result in workers.run(bench, _tasks(planned, done)):
        done[index] = completed(planned[index], result)
        if journal is not None:
            journal.append(done[index])
        progress(target.name, len(done))
    records = tuple(done[index] for index in sorted(done))
    return replace(prepared, records=records, wall_s=time.perf_counter() - begun)


def _prepare(plan: Plan, target: AttackTarget, stage: Stage) -> tuple[TargetRuns, JudgedPlace]:
    """Make golden run and profile; return them with the place where they were made."""
    begun = time.perf_counter()
    stage("loading")
    with contextlib.ExitStack() as undo:
        place = target.open()
        undo.callback(place.close)
        stage("golden runs")
        golden, profile = golden_run(place), None
        if plan.strategy().rule is Rule.INSTRUCTION:
            stage("profile")
            rng = Bench(plan=plan, target=target, golden=golden).generator("profile")
            profile = place.profile(rng, windows=plan.windows, watch=steps_told(stage))
        undo.pop_all()
    stream = {"kernel": target.stream[0]} if target.stream else {}
    prepared = TargetRuns(
        target=place.target,
        context=stream | place.context(),
        golden=golden,
        profile=profile,
        prepare_s=time.perf_counter() - begun,
    )
    return prepared, place


def _draw(plan: Plan, bench: Bench, prepared: TargetRuns) -> list[Record]:
    """Make the records of all faults before they run; time rules draw at the stop."""
    chosen, profile, records = plan.strategy(), prepared.profile, []
    for index in range(plan.runs):
        what = {"run": index, "seed": plan.seed, "sampling": chosen.name, **prepared.context}
        if profile is None:
            records.append({"version": record.VERSION, "state": "planned", "trigger": []} | what)
            continue
        fault = profile.draw(chosen, bench.generator(index))
        struck = replace(fault, corruption=None) if plan.null else fault
        records.append(record.planned(struck, profile.image, **what))
    return records


def _tasks(planned: Sequence[Record], done: Mapping[int, Record]) -> list[Any]:
    return [
        (index, record.fault_of(entry) if entry["trigger"] else None)
        for index, entry in enumerate(planned)
        if index not in done
    ]


def completed(planned: Mapping[str, Any], result: RunResult) -> Record:
    """Make the record of a run that is over."""
    fault = result.fault
    if fault is not None and not planned["trigger"]:  # a time trigger: it cannot be repeated
        planned = {
            **planned,
            "object": fault.target.object,
            "offset": fault.target.offset,
            "instruction": fault.instruction,
            "instruction_bytes": fault.instruction_bytes.hex(),
            "corruption": record.corruption_to_json(fault.corruption),
        }
    return record.completed(
        planned,
        result.injection,
        result.followed,
        outcome=result.outcome.value,
        signal=result.signal,
        **result.verdict.details,
        output_sha256=result.verdict.output_sha256,
        not_injected_reason=result.reason,
        run_s=result.run_s,
    )
