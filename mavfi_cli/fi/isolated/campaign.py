"""Many faults on one program: drawn first, stored, then run by parallel workers.

Fault number i depends on the seed and on i only, so the results do not depend on how many
workers there are, and workers never share a random stream.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import FaultError, RecordError
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.fi import record
from mavfi_cli.fi.isolated.outcome import Outcome, shares
from mavfi_cli.fi.isolated.program import (
    Golden,
    Profiled,
    ProgramTarget,
    RunResult,
    Workplace,
    golden_run,
    profile_program,
    run_fault,
    run_timed,
)
from mavfi_cli.fi.native.fault import FaultModel, InstructionFault
from mavfi_cli.fi.sampling import Rule, Strategy, draw_fault, strategy


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a campaign does; plain values, so that it can be handed to other processes."""

    target: ProgramTarget
    runs: int
    seed: int
    rule: str = Rule.INSTRUCTION.value
    compat: str | None = None
    model: FaultModel | None = None
    windows: int = 16  # sampled invocations, where a function is named
    null: bool = False  # everything but the flip

    def strategy(self) -> Strategy:
        """The sampling strategy."""
        return strategy(self.rule, self.model, compat=self.compat)


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One run with its number and the fault record."""

    index: int
    result: RunResult
    record: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """All runs of a plan, in order of their numbers."""

    plan: Plan
    golden: Golden
    profiled: Profiled | None  # None for time rules
    runs: tuple[Run, ...]
    wall_s: float

    def summary(self) -> dict[str, Any]:
        """Counts, shares and intervals, with everything that the numbers depend on."""
        outcomes = [run.result.outcome for run in self.runs]
        profile = None if self.profiled is None else self.profiled.profile
        signals: dict[str, int] = {}
        for run in self.runs:
            if run.result.outcome is Outcome.CRASH:
                number = run.result.signal
                key = f"signal {number}" if number else f"exit {run.result.exit_code}"
                signals[key] = signals.get(key, 0) + 1
        return {
            "program": list(self.plan.target.command.argv),
            "scope": list(self.plan.target.scope_objects),
            "function": self.plan.target.function,
            "sampling": self.plan.strategy().name,
            "seed": self.plan.seed,
            "runs": len(self.runs),
            "executed_in_scope": None if profile is None else profile.executed,
            "profile_complete": None if profile is None else profile.complete,
            "windows": None
            if profile is None
            else f"{len(profile.segments)} of {profile.windows_in_run}",
            "profile_s": None if profile is None else profile.cost_s,
            "golden_wall_s": self.golden.wall_s,
            "wall_s": self.wall_s,
            "outcomes": {
                outcome.value: {
                    "count": share.count,
                    "of": share.total,
                    "share": None if math.isnan(share.share) else share.share,
                    "wilson95": [share.low, share.high],
                }
                for outcome, share in shares(outcomes).items()
            },
            "crashes": dict(sorted(signals.items())),
            "not_injected": _counted(run.result.reason for run in self.runs if run.result.reason),
            "activation": _counted(run.result.followed.activation.value for run in self.runs),
        }


def _counted(names: Iterable[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for name in names:
        counts[name] = counts.get(name, 0) + 1
    return dict(sorted(counts.items()))


def run_campaign(
    plan: Plan,
    *,
    jobs: int = 1,
    folder: Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> Campaign:
    """Golden run, profile, fault list, runs.

    Args:
        plan: what to do.
        jobs: worker processes.
        folder: where the fault list is flushed before the first fault runs.
        progress: called with the number of finished runs.

    Raises:
        TracingForbidden: the operating system refuses.
        TargetError: the program cannot be attacked; says why.
    """
    start = time.perf_counter()
    with _one_processor():
        golden, profiled = _prepare(plan)
    faults = _draw(plan, profiled)
    records = [_planned(plan, profiled, index, fault) for index, fault in enumerate(faults)]
    if folder is not None:
        _flush(folder / "faults.jsonl", records)
    runs = []
    for index, result in _execute(plan, golden, faults, jobs):
        planned = records[index] | _hit(records[index], result.fault)
        completed = record.completed(
            planned, result.injection, result.followed, **_outcome_of(result)
        )
        runs.append(Run(index=index, result=result, record=completed))
        if progress is not None:
            progress(len(runs))
    runs.sort(key=lambda run: run.index)
    return Campaign(
        plan=plan,
        golden=golden,
        profiled=profiled,
        runs=tuple(runs),
        wall_s=time.perf_counter() - start,
    )


@contextmanager
def _one_processor() -> Iterator[None]:
    """Tracer and target hand over to each other all the time: fastest on one processor."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [max(before)])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _prepare(plan: Plan) -> tuple[Golden, Profiled | None]:
    place = Workplace(plan.target)
    try:
        golden = golden_run(plan.target, place)
        if plan.strategy().rule is not Rule.INSTRUCTION:
            return golden, None
        rng = generator(plan.seed, Stream.FAULT, "profile")
        return golden, profile_program(plan.target, place, rng, windows=plan.windows)
    finally:
        place.close()


def _outcome_of(result: RunResult) -> dict[str, Any]:
    return {
        "outcome": result.outcome.value,
        "signal": result.signal,
        "exit_code": result.exit_code,
        "magnitude": result.magnitude,
        "output_sha256": result.output_sha256,
        "not_injected_reason": result.reason,
        "run_s": result.run_s,
    }


def _draw(plan: Plan, profiled: Profiled | None) -> list[InstructionFault | None]:
    if profiled is None:
        return [None] * plan.runs
    chosen = plan.strategy()
    faults: list[InstructionFault | None] = []
    for index in range(plan.runs):
        fault = draw_fault(
            profiled.profile,
            chosen,
            generator(plan.seed, Stream.FAULT, index),
            code_at=profiled.code_at,
            locate=profiled.image.locate,
        )
        if plan.null:
            fault = replace(fault, corruption=None)
        faults.append(fault)
    return faults


def _planned(
    plan: Plan, profiled: Profiled | None, index: int, fault: InstructionFault | None
) -> dict[str, Any]:
    context = {
        "run": index,
        "seed": plan.seed,
        "sampling": plan.strategy().name,
        "program": list(plan.target.command.argv),
        "scope": list(plan.target.scope_objects),
        "function": plan.target.function,
    }
    if fault is None or profiled is None:
        return {"version": record.VERSION, "state": "planned", "trigger": [], **context}
    return record.planned(fault, profiled.image, **context)


def _hit(planned: dict[str, Any], fault: InstructionFault | None) -> dict[str, Any]:
    """What a time trigger hit; it has no k, so such a run cannot be repeated exactly."""
    if planned["trigger"] or fault is None:
        return {}
    return {
        "object": fault.target.object,
        "offset": fault.target.offset,
        "instruction": fault.instruction,
        "instruction_bytes": fault.instruction_bytes.hex(),
        "corruption": record.corruption_to_json(fault.corruption),
    }


def _flush(path: Path, records: Iterable[dict[str, Any]]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", encoding="utf-8") as stream:
            stream.writelines(json.dumps(entry) + "\n" for entry in records)
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror}") from None


# -- workers

_Task = tuple[int, InstructionFault | None]


class _Worker:
    """What one worker process keeps between runs."""

    current: _Worker | None = None

    def __init__(self, plan: Plan, golden: Golden, processors: list[int]) -> None:
        os.sched_setaffinity(0, processors)  # see _one_processor
        self.plan, self.golden = plan, golden
        self.place = Workplace(plan.target)

    def run(self, task: _Task) -> tuple[int, RunResult]:
        index, fault = task
        target, golden = self.plan.target, self.golden
        if fault is not None:
            return index, run_fault(target, self.place, golden, fault)
        rng = generator(self.plan.seed, Stream.FAULT, index)
        return index, run_timed(target, self.place, golden, self.plan.strategy(), rng)


def _start_worker(plan: Plan, golden: Golden, queue: Any) -> None:
    _Worker.current = _Worker(plan, golden, [queue.get()])


def _work(tasks: list[_Task]) -> list[tuple[int, RunResult]]:
    assert _Worker.current is not None
    return [_Worker.current.run(task) for task in tasks]


def _execute(
    plan: Plan, golden: Golden, faults: list[InstructionFault | None], jobs: int
) -> Iterator[tuple[int, RunResult]]:
    tasks: list[_Task] = list(enumerate(faults))
    processors = sorted(os.sched_getaffinity(0))
    if jobs <= 1:
        yield from _execute_here(plan, golden, tasks, processors)
        return
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    for worker in range(jobs):
        queue.put(processors[worker % len(processors)])
    size = max(1, min(64, len(tasks) // (4 * jobs)))
    chunks = [tasks[at : at + size] for at in range(0, len(tasks), size)]
    with ProcessPoolExecutor(
        jobs, mp_context=context, initializer=_start_worker, initargs=(plan, golden, queue)
    ) as pool:
        try:
            for results in pool.map(_work, chunks):
                yield from results
        except BrokenProcessPool:
            raise FaultError("a worker process was killed; the campaign is incomplete") from None
    queue.close()


def _execute_here(
    plan: Plan, golden: Golden, tasks: list[_Task], processors: list[int]
) -> Iterator[tuple[int, RunResult]]:
    with _one_processor():
        worker = _Worker(plan, golden, processors[-1:])
        try:
            for task in tasks:
                yield worker.run(task)
        finally:
            worker.place.close()


CSV_COLUMNS = (
    "run outcome signal exit_code magnitude object offset symbol instruction k site role operand "
    "bits before after activation not_injected_reason stop_s run_s output_sha256"
)


def csv_rows(campaign: Campaign) -> Iterator[list[str]]:
    """Header and one row a run."""
    columns = CSV_COLUMNS.split()
    yield columns
    for run in campaign.runs:
        flat = {**run.record, **(run.record.get("corruption") or {}), **run.record["injection"]}
        flat["activation"] = run.record["activation"]["activation"]
        flat["bits"] = " ".join(str(bit) for bit in flat.get("bits", ()))
        yield ["" if flat.get(name) is None else str(flat[name]) for name in columns]


def to_json(campaign: Campaign) -> dict[str, Any]:
    """Summary, golden run and all records."""
    golden = asdict(campaign.golden)
    golden.pop("output")
    return {
        "summary": campaign.summary(),
        "golden": golden,
        "runs": [run.record for run in campaign.runs],
    }
