"""Thousands of runs over all kernels: drawn first, stored, run by parallel workers, resumed.

Fault number i of a kernel depends on the seed, the kernel and i only, so the results depend neither
on the number of workers nor on which kernels are attacked beside it.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.kernels import catalogue, journal
from mavfi_cli.campaign.kernels.attack import (
    Attacker,
    Golden,
    RunResult,
    golden_run,
    without_flip,
)
from mavfi_cli.campaign.kernels.place import Layout, Place, load, template_of
from mavfi_cli.campaign.kernels.profile import KernelProfile, profile_kernel
from mavfi_cli.core.errors import FaultError
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.fi import record
from mavfi_cli.fi.native.fault import FaultModel, InstructionFault
from mavfi_cli.fi.sampling import Rule, Strategy, strategy

Progress = Callable[[str, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a campaign does; plain values, so that it can be handed to other processes."""

    kernels: tuple[str, ...]
    runs: int  # of each kernel
    seed: int
    inputs: Path
    inputs_sha256: str
    flight: str
    rule: str = Rule.INSTRUCTION.value
    compat: str | None = None
    model: FaultModel | None = None
    windows: int = 16  # sampled invocations, where a kernel is too long to be stepped
    tolerance: float = 0.0
    null: bool = False  # everything but the flip

    def strategy(self) -> Strategy:
        """The sampling strategy."""
        return strategy(self.rule, self.model, compat=self.compat)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prepared:
    """A kernel that is ready to be attacked."""

    kernel: str
    layout: Layout
    golden: Golden
    profile: KernelProfile | None  # None for time rules
    prepare_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelRuns:
    """All runs of one kernel, in order of their numbers."""

    prepared: Prepared
    records: tuple[dict[str, Any], ...]
    wall_s: float


def run_kernels(
    plan: Plan,
    *,
    jobs: int = 1,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> list[KernelRuns]:
    """Golden run, profile, fault list and runs of every kernel.

    Args:
        plan: what to do.
        jobs: worker processes.
        folder: where records go; the runs that it has already are not repeated.
        progress: called with the kernel and the number of its runs that are there.

    Raises:
        TracingForbidden: the operating system refuses.
        TargetError: a kernel cannot be attacked; says why.
        ConfigError: the folder holds another campaign.
    """
    book = None if folder is None else journal.Journal(folder, plan)
    with _Workers(plan, jobs) as workers:
        return [_run_kernel(plan, name, workers, book, progress) for name in plan.kernels]


def _run_kernel(
    plan: Plan,
    name: str,
    workers: _Workers,
    book: journal.Journal | None,
    progress: Progress | None,
) -> KernelRuns:
    begun = time.perf_counter()
    with one_processor():
        prepared, planned = _prepare(plan, name)
    faults = [None if not entry["trigger"] else record.fault_of(entry) for entry in planned]
    done: dict[int, dict[str, Any]] = {}
    if book is not None:
        done = book.runs_of(name, planned)
        book.flush_plan(name, planned)
    tasks = [(index, fault) for index, fault in enumerate(faults) if index not in done]
    for index, result in workers.run(prepared, tasks):
        done[index] = completed(planned[index], result)
        if book is not None:
            book.append(done[index])
        if progress is not None:
            progress(name, len(done))
    return KernelRuns(
        prepared=prepared,
        records=tuple(done[index] for index in sorted(done)),
        wall_s=time.perf_counter() - begun,
    )


def _prepare(plan: Plan, name: str) -> tuple[Prepared, list[dict[str, Any]]]:
    """Golden run, profile, and the records of all faults as drawn."""
    begun = time.perf_counter()
    kernel, template = catalogue.find(name), template_of(name, plan.inputs)
    load(name, template)
    with closing(Place(name, template)) as place:
        golden = golden_run(place)
        profile = None
        if plan.strategy().rule is Rule.INSTRUCTION:
            rng = generator(plan.seed, Stream.FAULT, name, "profile")
            profile = profile_kernel(place, rng, windows=plan.windows, inner=kernel.too_long)
        planned = [_planned(plan, place, profile, index) for index in range(plan.runs)]
        prepared = Prepared(
            kernel=name,
            layout=place.layout,
            golden=golden,
            profile=profile,
            prepare_s=time.perf_counter() - begun,
        )
    return prepared, planned


def _planned(plan: Plan, place: Place, profile: KernelProfile | None, index: int) -> dict[str, Any]:
    context = {
        "kernel": place.kernel,
        "run": index,
        "seed": plan.seed,
        "sampling": plan.strategy().name,
        "scope": list(place.layout.scope.objects),
        "inputs_sha256": plan.inputs_sha256,
    }
    if profile is None:
        return {"version": record.VERSION, "state": "planned", "trigger": [], **context}
    rng = generator(plan.seed, Stream.FAULT, place.kernel, index)
    fault = profile.draw(place, plan.strategy(), rng)
    return record.planned(
        without_flip(fault) if plan.null else fault, place.layout.image, **context
    )


def completed(planned: dict[str, Any], result: RunResult) -> dict[str, Any]:
    """The record of a run that is over."""
    fault = result.fault
    if fault is not None and not planned["trigger"]:  # a time trigger: it cannot be repeated
        planned = planned | {
            "object": fault.target.object,
            "offset": fault.target.offset,
            "instruction": fault.instruction,
            "instruction_bytes": fault.instruction_bytes.hex(),
            "corruption": record.corruption_to_json(fault.corruption),
        }
    difference = result.difference
    return record.completed(
        planned,
        result.injection,
        result.followed,
        outcome=result.outcome.value,
        signal=result.signal,
        error=result.error,
        magnitude=None if difference is None else difference.to_json(),
        within_tolerance=result.within_tolerance,
        output_sha256=result.output_sha256,
        not_injected_reason=result.reason,
        run_s=result.run_s,
    )


@contextmanager
def one_processor() -> Iterator[None]:
    """Tracer and target hand over to each other all the time: fastest on one processor."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [max(before)])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


# -- workers

_Task = tuple[int, InstructionFault | None]
_Job = tuple[Plan, str, Layout, Golden, list[_Task]]


class _Bench:
    """What a worker process keeps between jobs: the template of one kernel."""

    place: Place | None = None

    @classmethod
    def attacker(cls, plan: Plan, name: str, layout: Layout, golden: Golden) -> Attacker:
        if cls.place is None or cls.place.kernel != name:
            cls.clear()
            cls.place = Place(name, template_of(name, plan.inputs), layout=layout)
        kernel = catalogue.find(name)
        return Attacker(kernel=kernel, place=cls.place, golden=golden, tolerance=plan.tolerance)

    @classmethod
    def clear(cls) -> None:
        if cls.place is not None:
            cls.place.close()
            cls.place = None


def _work(job: _Job) -> list[tuple[int, RunResult]]:
    plan, name, layout, golden, tasks = job
    attacker = _Bench.attacker(plan, name, layout, golden)
    results = []
    for index, fault in tasks:
        if fault is not None:
            results.append((index, attacker.run(fault)))
        else:
            rng = generator(plan.seed, Stream.FAULT, name, index)
            results.append((index, attacker.run_timed(plan.strategy(), rng)))
    return results


def _settle(queue: Any) -> None:
    os.sched_setaffinity(0, [queue.get()])


class _Workers:
    """Worker processes, or this process where one is enough; a context."""

    def __init__(self, plan: Plan, jobs: int) -> None:
        self._plan = plan
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> _Workers:
        if self._jobs > 1:
            context = multiprocessing.get_context("spawn")
            processors, queue = sorted(os.sched_getaffinity(0)), context.Queue()
            for worker in range(self._jobs):
                queue.put(processors[worker % len(processors)])
            self._pool = ProcessPoolExecutor(
                self._jobs, mp_context=context, initializer=_settle, initargs=(queue,)
            )
        return self

    def __exit__(self, *_: object) -> None:
        _Bench.clear()
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def run(self, prepared: Prepared, tasks: list[_Task]) -> Iterator[tuple[int, RunResult]]:
        """The results in the order of the tasks."""
        size = max(1, min(32, len(tasks) // (4 * self._jobs)))
        jobs: list[_Job] = [
            (self._plan, prepared.kernel, prepared.layout, prepared.golden, tasks[at : at + size])
            for at in range(0, len(tasks), size)
        ]
        if self._pool is None:
            for job in jobs:
                with one_processor():
                    results = _work(job)
                yield from results
            return
        try:
            for results in self._pool.map(_work, jobs):
                yield from results
        except BrokenProcessPool:
            raise FaultError("a worker process was killed; the campaign is incomplete") from None
