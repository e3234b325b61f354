"""Runs many faults on each of several targets: golden run, profile, fault list, runs.

Fault number i of a target depends only on the seed, the target's own stream and i. So the results
depend neither on the number of workers nor on the other targets. A target with several inputs uses
them in rotation: fault i strikes input i modulo their number. A worker process keeps a target open
and runs its faults in order.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from mavfi_cli.attack.attacker import Attacker, RunResult, Task, golden_run
from mavfi_cli.attack.journal import Journal, read_plan, read_runs
from mavfi_cli.attack.null_runs import NullRuns, Profiles, Run, make_null_runs, require_golden_again
from mavfi_cli.attack.place import Golden, Watch
from mavfi_cli.attack.profile import TargetProfile, started
from mavfi_cli.attack.target import AttackTarget, JudgedPlace, places_of
from mavfi_cli.core.compiled import own_digest
from mavfi_cli.core.errors import (
    BuildMismatch,
    ConfigError,
    FaultError,
    RecordError,
    TargetError,
)
from mavfi_cli.core.files import Json
from mavfi_cli.core.fork_server import die_with
from mavfi_cli.core.seeds import Stream
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.fault import FaultModel, InstructionFault, Rule, Strategy
from mavfi_cli.fi.tracer.record_fields import FaultRecord

if TYPE_CHECKING:
    from mavfi_cli.attack.program import ProgramTarget


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """How a campaign draws its faults. Each target gets `runs` faults, one for each run."""

    runs: int
    seed: int
    rule: str = Rule.INSTRUCTION.value
    compat: str | None = None
    model: FaultModel | None = None
    windows: int = 16  # number of stepped windows, unless the whole run is stepped
    null: bool = False  # leave out the flip

    def strategy(self) -> Strategy:
        """Return the strategy by which faults are drawn, from `rule`, `model` and `compat`."""
        return Strategy.of(self.rule, self.model, compat=self.compat)

    def to_json(self, target: AttackTarget) -> Json:
        """Return the settings of plan and target that determine the results, except `runs`."""
        return {
            "seed": self.seed,
            "rule": self.rule,
            "compat": self.compat,
            "windows": self.windows,
            "null": self.null,
            "model": self.strategy().model.to_json(),
            **target.settings(),
        }


Progress = Callable[[str, int], None]
Stage = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetRuns:
    """All runs of one target, ordered by number, and the profiles that their faults come from."""

    target: AttackTarget
    context: Mapping[str, Any]  # entries about the target in every record
    goldens: tuple[Golden, ...]  # one per input
    profiles: Profiles
    null_runs: NullRuns
    records: tuple[FaultRecord, ...] = ()
    prepare_s: float
    wall_s: float = 0.0

    @property
    def golden(self) -> Golden:
        """The golden run of the first input."""
        return self.goldens[0]

    @property
    def profile(self) -> TargetProfile | None:
        """The profile of the first input, or None if the faults are drawn by time."""
        return self.profiles[0]

    def input_of(self, run: int) -> int:
        """Return the number of the input that fault number `run` strikes."""
        return run % len(self.goldens)

    def records_of(self, number: int) -> tuple[FaultRecord, ...]:
        """Return the records of the runs whose faults strike input `number`."""
        return self.records[number :: len(self.goldens)]


def run_campaign(
    plan: Plan,
    targets: Sequence[AttackTarget],
    *,
    jobs: int = 1,
    folder: Path | None = None,
    progress: Progress = lambda _name, _done: None,
    stage: Stage = lambda _: None,
    notice: Stage = lambda _: None,
) -> list[TargetRuns]:
    """Run a campaign of faults against each target, and return the runs of every target.

    For each target: make golden runs, profile its instructions, draw the faults, and make one run
    with each fault.

    Args:
        targets: one or more targets. If there are several, their random streams must differ.
        folder: receives the list of faults before the first run, and the record of each run
            as it ends. Runs that it already holds are not repeated.
        progress: called with the target's name and its number of completed runs, first with 0
            before the golden run.
        stage: called with a description of each step.
        notice: called with each warning about a golden run.

    Raises:
        TracingForbidden: the operating system does not allow tracing.
        TargetError: a target cannot be attacked.
        ConfigError: the folder holds another campaign, or runs that this one does not include.
    """
    journal = None
    if folder is not None:
        names = [target.stream[0] for target in targets if target.stream]
        journal = Journal(folder, plan.to_json(targets[0]), runs=plan.runs, kernels=names or None)
    with _AttackWorkers(jobs) as workers:
        return [
            _attack(plan, target, workers, journal, progress, stage, notice) for target in targets
        ]


def _attack(
    plan: Plan,
    target: AttackTarget,
    workers: _AttackWorkers,
    journal: Journal | None,
    progress: Progress,
    stage: Stage,
    notice: Stage,
) -> TargetRuns:
    begun = time.perf_counter()
    progress(target.name, 0)
    with one_processor():
        place, goldens, profiles = _prepare(plan, target, stage, notice)
    golden_s = time.monotonic()
    stream = {"kernel": target.stream[0]} if target.stream else {}
    context = stream | place.context()
    setup = _TargetSetup(plan=plan, target=target, golden=goldens)
    workers.take(setup, place)
    stage("null runs")
    profiles, null_runs = make_null_runs(target.name, profiles, setup.draw, workers.null(setup))
    for method in null_runs.unused:
        notice(
            f"{target.name} reads its own code as data: its output changes even without a flip "
            f"when a {method} counts executions, so none is used"
        )
    prepared = TargetRuns(
        target=target,
        context=context,
        goldens=goldens,
        profiles=profiles,
        null_runs=null_runs,
        prepare_s=time.perf_counter() - begun,
    )
    stage(f"drawing {plan.runs} faults")
    planned = _draw(plan, setup, prepared)
    done: dict[int, FaultRecord] = {}
    if journal is not None:
        done = journal.runs_of(planned)
        journal.flush_plan("-".join(("faults", *target.stream)) + ".jsonl", planned)
    tasks = [
        (index, record.fault_of(entry) if entry["trigger"] else None)
        for index, entry in enumerate(planned)
        if index not in done
    ]
    for first in range(0, len(tasks), _RECHECKED):
        for index, result in workers.run(setup, tasks[first : first + _RECHECKED]):
            done[index] = result.completed(planned[index])
            if journal is not None:
                journal.append(done[index])
            progress(target.name, len(done))
        require_golden_again(target.name, null_runs, workers.null(setup), golden_s)
    records = tuple(done[index] for index in sorted(done))
    return replace(prepared, records=records, wall_s=time.perf_counter() - begun)


def _prepare(
    plan: Plan, target: AttackTarget, stage: Stage, notice: Stage
) -> tuple[JudgedPlace, tuple[Golden, ...], Profiles]:
    """Open the target, and make a golden run and a profile for each of its inputs.

    The profiles are None if the rule draws faults by time.
    """
    stage("loading")
    with contextlib.ExitStack() as undo:
        place = target.open()
        undo.callback(place.close)
        stage("golden runs")
        golden = tuple(golden_run(part) for part in places_of(place))
        for text in dict.fromkeys(text for run in golden for text in run.notices):
            notice(text)
        rng = _TargetSetup(plan=plan, target=target, golden=golden).generator("profile")
        profiles: Profiles = (None,) * len(golden)
        if plan.strategy().rule is Rule.INSTRUCTION:
            stage("profile")
            profiles = tuple(
                part.profile(rng, windows=plan.windows, watch=_report_steps(stage))
                for part in places_of(place)
            )
        undo.pop_all()
    return place, golden, profiles


def _report_steps(stage: Callable[[str], None]) -> Watch:
    """Return a `Watch` that passes progress to `stage`: stepped instructions so far, or a text."""
    total = 0

    def watch(news: int | str) -> None:
        nonlocal total
        if isinstance(news, int):
            total += news
            news = f"{total} instructions stepped"
        stage(f"profile, {news}")

    return watch


def _draw(plan: Plan, setup: _TargetSetup, prepared: TargetRuns) -> list[FaultRecord]:
    """Draw all faults of a target, and return their records as planned.

    A fault that is drawn by time gets a record without an instruction. It is drawn during its run.
    """
    chosen, records = plan.strategy(), list[FaultRecord]()
    for index in range(plan.runs):
        number = prepared.input_of(index)
        profile, fault = prepared.profiles[number], setup.draw(prepared.profiles, index)
        what = {"run": index, "seed": plan.seed, "sampling": chosen.name, **prepared.context}
        if len(prepared.goldens) > 1:
            what["input"] = number
        if profile is None or fault is None:
            records.append(record.undrawn(**what))
            continue
        assert profile.image is not None
        struck = replace(fault, corruption=None) if plan.null else fault
        records.append(record.planned(struck, profile.image, **what))
    return records


# -- worker processes

_CHUNK = 32  # tasks that are sent to a worker at once
_TERMINATED = 128 + signal.SIGTERM
_RECHECKED = 1000  # number of runs after which a null run is repeated


_claims: list[socket.socket] = []  # of this process


@contextmanager
def one_processor() -> Iterator[None]:
    """Keep this process on one processor within the context.

    Tracer and target alternate constantly, and switching is fastest on one processor.
    """
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [_claimed_processor()])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@functools.lru_cache(maxsize=1)
def _claimed_processor() -> int:
    """Claim a processor for this process and its children, and return the processor's number.

    No other campaign uses a claimed processor. The claim is an abstract socket name, so it ends
    with the process. If all processors are claimed, one of them is shared.
    """
    claim, processors = socket.socket(socket.AF_UNIX), sorted(os.sched_getaffinity(0), reverse=True)
    _claims.append(claim)
    for processor in processors:
        with contextlib.suppress(OSError):
            claim.bind(f"\0mavfi-processor-{processor}")
            return processor
    return processors[os.getpid() % len(processors)]


def _give_up_processor() -> None:
    """Release the claimed processor."""
    while _claims:
        _claims.pop().close()
    _claimed_processor.cache_clear()


@dataclass(frozen=True, slots=True, kw_only=True)
class _TargetSetup:
    """A plan, a target and its golden runs, as plain values that can be sent to a worker."""

    plan: Plan
    target: AttackTarget
    golden: tuple[Golden, ...]  # one per input

    def attackers(self, place: JudgedPlace) -> tuple[Attacker, ...]:
        """Return one attacker for each input of the opened target."""
        pairs = zip(places_of(place), self.golden, strict=True)
        return tuple(Attacker(place=part, golden=golden) for part, golden in pairs)

    def generator(self, *what: str | int) -> np.random.Generator:
        """Return a random generator from the target's stream. `what` names its purpose."""
        return Stream.FAULT.generator(self.plan.seed, *self.target.stream, *what)

    def draw(self, profiles: Profiles, index: int) -> InstructionFault | None:
        """Draw fault number `index`. Return None if the rule draws faults by time."""
        profile = profiles[index % len(profiles)]
        if profile is None:
            return None
        return profile.draw(self.plan.strategy(), self.generator(index))


_opened: dict[tuple[str, ...], tuple[Attacker, ...]] = {}  # the only target that is open here


def _keep_open(setup: _TargetSetup, place: JudgedPlace) -> tuple[Attacker, ...]:
    """Keep `place` open for later chunks of tasks, and return one attacker for each of its inputs.

    The place that was open before is closed.
    """
    _close()
    return _opened.setdefault(setup.target.stream, setup.attackers(place))


def _close() -> None:
    while _opened:
        _opened.popitem()[1][0].place.close()


def _work_in_pool(job: tuple[_TargetSetup, Sequence[Task]]) -> list[tuple[int, RunResult]]:
    try:
        return _work(job)
    except SystemExit:  # the pool would pass it to the client and start the next chunk
        _close()
        os._exit(_TERMINATED)


def _work(job: tuple[_TargetSetup, Sequence[Task]]) -> list[tuple[int, RunResult]]:
    setup, tasks = job
    attackers = _opened.get(setup.target.stream) or _keep_open(setup, setup.target.open())
    results = []
    for index, fault in tasks:
        attacker = attackers[index % len(attackers)]
        if fault is not None:
            results.append((index, attacker.run(fault)))
        else:
            plan, rng = setup.plan, setup.generator(index)
            results.append((index, attacker.run_timed(plan.strategy(), rng, null=plan.null)))
    return results


def _settle(campaign: int) -> None:
    """Prepare a worker process, which ends together with the process `campaign`.

    SIGTERM ends the worker without leaving a process or a folder behind.
    """
    die_with(campaign)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the campaign
    signal.signal(signal.SIGTERM, _leave)
    os.sched_setaffinity(0, [_claimed_processor()])


def _leave(*_: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(_TERMINATED)


class _AttackWorkers:
    """Context manager for the worker processes of one campaign, or this process if `jobs` is 1."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> _AttackWorkers:
        if self._jobs > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(
                self._jobs, mp_context=context, initializer=_settle, initargs=(os.getpid(),)
            )
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        _close()
        if self._pool is not None:
            # A chunk may last for an hour. Python 3.14 has `terminate_workers`.
            for worker in list(self._pool._processes.values()) if error is not None else ():
                worker.terminate()
            self._pool.shutdown(cancel_futures=True)
        _give_up_processor()

    def take(self, setup: _TargetSetup, place: JudgedPlace) -> None:
        """Keep `place` open for runs in this process, or close it if workers do the runs."""
        if self._pool is None:
            _keep_open(setup, place)
        else:
            place.close()
            _give_up_processor()

    def null(self, setup: _TargetSetup) -> Run:
        """Return a function that makes null runs: it runs tasks, but leaves out their flips."""
        without = replace(setup, plan=replace(setup.plan, null=True))

        def run(tasks: Sequence[Task]) -> Iterator[tuple[int, RunResult]]:
            faults = [(n, fault and replace(fault, corruption=None)) for n, fault in tasks]
            return self.run(without, faults)

        return run

    def run(self, setup: _TargetSetup, tasks: Sequence[Task]) -> Iterator[tuple[int, RunResult]]:
        """Run the tasks, and yield the number and result of each, in the order of the tasks.

        Raises:
            FaultError: a worker process was killed.
            TargetError: the target cannot be sent to a worker.
        """
        if self._pool is None:
            for task in tasks:
                with one_processor():
                    results = _work((setup, [task]))
                yield from results
            return
        try:
            pickle.dumps(setup)
        except Exception as error:  # the target may raise anything
            problem = f"cannot be sent to a worker process: {error}"
            raise TargetError(setup.target.name, problem) from None
        size = max(1, min(_CHUNK, len(tasks) // (4 * self._jobs)))
        jobs = [(setup, tasks[at : at + size]) for at in range(0, len(tasks), size)]
        try:
            for results in self._pool.map(_work_in_pool, jobs):
                yield from results
        except BrokenProcessPool:
            raise FaultError("a worker process was killed; the campaign is incomplete") from None


# -- recorded runs are repeated bit for bit

# A replay must repeat these entries; durations are not among them.
_COMPARED = (
    "outcome", "signal", "exit_code", "error", "magnitude", "within_tolerance", "output_sha256",
    "not_injected_reason", "activation",
)  # fmt: skip
_INJECTION = ("applied", "reason", "address", "before", "after")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Replay:
    target: str  # name of the kernel or program
    run: int
    differs: tuple[str, ...]  # keys of the record that differ; empty if it is identical
    record: FaultRecord


def replay_runs(
    folder: Path,
    kernels: tuple[str, ...] = (),
    runs: int = 0,
    program: ProgramTarget | None = None,
) -> Iterator[_Replay]:
    """Repeat recorded runs from a campaign's folder, and yield how each differs from its record.

    Args:
        kernels: names of the kernels whose runs are repeated; empty for all built-in kernels.
        runs: number of runs to repeat per kernel, or of the program; 0 for all.
        program: the program that the user named. The folder may come from somebody else, so the
            program recorded there is executed only if it is the same.

    Raises:
        RecordError: the folder holds no repeatable runs.
        ConfigError: the folder holds runs of a program that the user did not name, or no runs of
            the named one.
        BuildMismatch: a record comes from another build.
    """
    plan, repeated = read_plan(folder), False
    for target in _targets(plan, folder, kernels, program):
        name = (target.stream or (None,))[0]
        entries = [entry for entry in read_runs(folder) if entry.get("kernel") == name]
        records = [entry for entry in entries if entry.get("trigger") != []]
        if not records:
            continue
        repeated = True
        with one_processor(), contextlib.closing(target.open()) as place:
            places = places_of(place)
            attackers = [Attacker(place=part, golden=golden_run(part)) for part in places]
            with started(places[0]) as tracee:
                image = places[0].image(tracee)
            for entry in records[: runs or None]:
                record.require_same_build(entry, image)
                number = entry.get("input", 0)
                if not 0 <= number < len(attackers):
                    raise RecordError(f"{folder}: a run has an unknown input number, {number}")
                yield _replay(attackers[number], entry)
    if not repeated:
        raise RecordError(f"{folder}: holds no run that can be repeated")


def _targets(
    plan: Json,
    folder: Path,
    kernels: tuple[str, ...],
    program: ProgramTarget | None,
) -> Iterator[AttackTarget]:
    from mavfi_cli.attack.kernels import catalogue
    from mavfi_cli.attack.kernels.inputs import INPUTS
    from mavfi_cli.attack.kernels.target import KernelTarget

    if "program" in plan:
        if kernels:
            raise RecordError(f"{folder}: holds runs of a program, not of {' and '.join(kernels)}")
        if program is None:
            raise ConfigError(
                f"holds runs of the program {plan['program']!r}, which would be executed: if you "
                "trust it, give --program and the other options of the campaign again",
                path=folder,
            )
        known = {"stdin": None, "files": None, **program.settings()}
        if differs := [name for name, value in known.items() if plan.get(name) != value]:
            problem = f"holds runs of another program; it differs in {differs}"
            raise ConfigError(problem, path=folder)
        yield program
        return
    if program is not None:
        raise ConfigError("holds no runs of a program, so omit --program", path=folder)
    if "inputs_sha256" not in plan:
        raise RecordError(f"{folder}: holds no runs of kernels or of a program")
    if plan.get("sources") != own_digest():  # other code has another memory layout
        raise BuildMismatch(["mavfi's own code differs"])
    for kernel in catalogue.select(kernels):
        tolerance = float(plan["tolerance"])
        yield KernelTarget(kernel=kernel, inputs=folder / INPUTS, tolerance=tolerance)


def _replay(attacker: Attacker, entry: FaultRecord) -> _Replay:
    again = attacker.run(record.fault_of(entry)).completed(entry)
    differs = [name for name in _COMPARED if again.get(name) != entry.get(name)]
    was, now = entry.get("injection", {}), again["injection"]
    differs += [name for name in _INJECTION if now.get(name) != was.get(name)]
    return _Replay(
        target=attacker.place.name, run=entry["run"], differs=tuple(differs), record=again
    )
