"""Thousands of runs over all kernels.

Fault number i of a kernel depends on the seed, the kernel and i only, so the results depend neither
on the number of workers nor on which kernels are attacked beside it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.kernels import catalogue
from mavfi_cli.campaign.kernels.attack import Golden, KernelVerdict, attacker_of, golden_run
from mavfi_cli.campaign.kernels.place import Layout, Place, load, template_of
from mavfi_cli.campaign.kernels.profile import profile_kernel
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.sources import own_digest
from mavfi_cli.fi.isolated.attack import Attacker
from mavfi_cli.fi.isolated.journal import Journal
from mavfi_cli.fi.isolated.profile import TargetProfile, in_words
from mavfi_cli.fi.isolated.runs import (
    FaultPlan,
    Record,
    Workers,
    draw_records,
    one_processor,
    run_records,
)
from mavfi_cli.fi.sampling import Rule

Progress = Callable[[str, int], None]
Stage = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan(FaultPlan):
    """What a campaign on kernels does; `runs` is of each."""

    kernels: tuple[str, ...]
    inputs: Path
    inputs_sha256: str
    flight: str
    tolerance: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """What results depend on; neither how many runs nor which kernels does."""
        return FaultPlan.to_json(self) | {
            "inputs_sha256": self.inputs_sha256,
            "flight": self.flight,
            "tolerance": self.tolerance,
            "sources": own_digest(),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Prepared:
    """A kernel that is ready to be attacked."""

    kernel: str
    layout: Layout
    golden: Golden
    profile: TargetProfile | None  # None for time rules
    prepare_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelRuns:
    """All runs of one kernel, in order of their numbers."""

    prepared: Prepared
    records: tuple[Record, ...]
    wall_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bench:
    plan: Plan
    kernel: str
    layout: Layout
    golden: Golden

    @property
    def stream(self) -> tuple[str, ...]:
        """Of its random numbers: a kernel's own."""
        return (self.kernel,)

    def open(self) -> Attacker[KernelVerdict]:
        """Start the kernel's process, in this worker."""
        template = template_of(self.kernel, self.plan.inputs)
        return self.attacker(Place(self.kernel, template, layout=self.layout))

    def attacker(self, place: Place) -> Attacker[KernelVerdict]:
        """Attacks in a place that is open already."""
        kernel = catalogue.find(self.kernel)
        return attacker_of(kernel, place, self.golden, tolerance=self.plan.tolerance)


def run_kernels(
    plan: Plan,
    *,
    jobs: int = 1,
    folder: Path | None = None,
    progress: Progress | None = None,
    stage: Stage = lambda _: None,
) -> list[KernelRuns]:
    """Golden run, profile, fault list and runs of every kernel.

    Args:
        plan: what to do.
        jobs: worker processes.
        folder: where records go; the runs that it has already are not repeated.
        progress: called with the kernel and the number of its runs that are there; with 0 before
            its golden run and profile.
        stage: called with what goes on before a kernel's first run.

    Raises:
        TracingForbidden: the operating system refuses.
        TargetError: a kernel cannot be attacked; says why.
        ConfigError: the folder holds another campaign, or runs that this one leaves out.
    """
    journal = None
    if folder is not None:
        journal = Journal(folder, plan.to_json(), runs=plan.runs, kernels=plan.kernels)
    with Workers(jobs) as workers:
        return [_run_kernel(plan, name, workers, journal, progress, stage) for name in plan.kernels]


def _run_kernel(
    plan: Plan,
    name: str,
    workers: Workers,
    journal: Journal | None,
    progress: Progress | None,
    stage: Stage,
) -> KernelRuns:
    begun = time.perf_counter()
    if progress is not None:
        progress(name, 0)
    with one_processor():
        prepared, place = _prepare(plan, name, stage)
    stage(f"drawing {plan.runs} faults")
    bench = _Bench(plan=plan, kernel=name, layout=prepared.layout, golden=prepared.golden)
    workers.take(bench, bench.attacker(place))
    context = {
        "kernel": name,
        "scope": list(prepared.layout.scope.objects),
        "inputs_sha256": plan.inputs_sha256,
    }
    records = run_records(
        bench,
        draw_records(bench, prepared.profile, context),
        workers,
        journal=journal,
        name=f"faults-{name}.jsonl",
        progress=None if progress is None else lambda done: progress(name, done),
    )
    return KernelRuns(prepared=prepared, records=records, wall_s=time.perf_counter() - begun)


def _prepare(plan: Plan, name: str, stage: Stage) -> tuple[Prepared, Place]:
    """Golden run and profile, and the place where they were made."""
    begun = time.perf_counter()
    kernel, template = catalogue.find(name), template_of(name, plan.inputs)
    stage("loading")
    load(name, template)
    with contextlib.ExitStack() as undo:
        place = undo.enter_context(contextlib.closing(Place(name, template)))
        stage("golden runs")
        golden, profile = golden_run(place), None
        if plan.strategy().rule is Rule.INSTRUCTION:
            rng = generator(plan.seed, Stream.FAULT, name, "profile")
            stage("profile")
            profile = profile_kernel(
                place, rng, windows=plan.windows, sampled=kernel.too_long, watch=in_words(stage)
            )
        undo.pop_all()
    prepared = Prepared(
        kernel=name,
        layout=place.layout,
        golden=golden,
        profile=profile,
        prepare_s=time.perf_counter() - begun,
    )
    return prepared, place
