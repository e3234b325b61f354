"""Many faults on one target: drawn first, stored, run by parallel workers, resumed.

Fault number i depends on the seed, the target's own stream and i only, so results do not depend on
how many workers there are, and workers never share a random stream.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from mavfi_cli.core.errors import FaultError
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.fi import record
from mavfi_cli.fi.isolated.attack import Attacker, RunResult, without_flip
from mavfi_cli.fi.isolated.journal import Journal
from mavfi_cli.fi.isolated.profile import TargetProfile
from mavfi_cli.fi.native.fault import FaultModel, InstructionFault
from mavfi_cli.fi.sampling import Rule, Strategy, strategy

Record = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultPlan:
    """Which faults are drawn; plain values, so that it can be handed to other processes."""

    runs: int
    seed: int
    rule: str = Rule.INSTRUCTION.value
    compat: str | None = None
    model: FaultModel | None = None
    windows: int = 16  # stepped, where not all that executes is
    null: bool = False  # everything but the flip

    def strategy(self) -> Strategy:
        """The sampling strategy."""
        return strategy(self.rule, self.model, compat=self.compat)

    def to_json(self) -> dict[str, Any]:
        """What results depend on; how many runs there are is not part of it."""
        return {
            "seed": self.seed,
            "rule": self.rule,
            "compat": self.compat,
            "windows": self.windows,
            "null": self.null,
            "model": self.strategy().model.to_json(),
        }


class Bench(Protocol):
    """A target as it is handed to a worker process: plain values."""

    @property
    def plan(self) -> FaultPlan:
        """Of its faults."""

    @property
    def stream(self) -> tuple[str, ...]:
        """Of its random numbers; what one worker has open is known by it."""

    def open(self) -> Attacker[Any]:
        """Get ready, in this process."""


def draw_records(
    bench: Bench, profile: TargetProfile | None, context: Mapping[str, Any]
) -> list[Record]:
    """The records of all faults before they run.

    Args:
        bench: the target.
        profile: of its fault-free run; None for time rules, which draw at the stop.
        context: what else belongs in every record.
    """
    plan, records = bench.plan, []
    for index in range(plan.runs):
        what = {"run": index, "seed": plan.seed, "sampling": plan.strategy().name, **context}
        if profile is None:
            empty = {"version": record.VERSION, "state": "planned", "trigger": []}
            records.append(empty | what)
            continue
        fault = profile.draw(plan.strategy(), _generator(bench, index))
        drawn = without_flip(fault) if plan.null else fault
        records.append(record.planned(drawn, profile.image, **what))
    return records


def _generator(bench: Bench, index: int) -> Any:
    return generator(bench.plan.seed, Stream.FAULT, *bench.stream, index)


def run_records(
    bench: Bench,
    planned: Sequence[Record],
    workers: Workers,
    *,
    journal: Journal | None = None,
    name: str = "faults.jsonl",
    progress: Callable[[int], None] | None = None,
) -> tuple[Record, ...]:
    """Run what is not in the journal yet; the completed records of all, in order.

    Args:
        bench: the target.
        planned: records as drawn.
        workers: who runs them.
        journal: where they go, and what is there already.
        name: of the file with the records as drawn.
        progress: called with the number of runs that are there.
    """
    done: dict[int, Record] = {}
    if journal is not None:
        done = journal.runs_of(planned)
        journal.flush_plan(name, planned)
    tasks = [
        (index, record.fault_of(entry) if entry["trigger"] else None)
        for index, entry in enumerate(planned)
        if index not in done
    ]
    for index, result in workers.run(bench, tasks):
        done[index] = completed(planned[index], result)
        if journal is not None:
            journal.append(done[index])
        if progress is not None:
            progress(len(done))
    return tuple(done[index] for index in sorted(done))


def completed(planned: Mapping[str, Any], result: RunResult[Any]) -> Record:
    """The record of a run that is over."""
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
        **result.verdict.to_json(),
        output_sha256=result.verdict.output_sha256,
        not_injected_reason=result.reason,
        run_s=result.run_s,
    )


def csv_table(columns: Sequence[str], records: Iterable[Mapping[str, Any]]) -> Iterator[list[str]]:
    """Header and one row a record; what a record does not have is empty."""
    yield list(columns)
    for entry in records:
        flat = {**entry, **(entry.get("corruption") or {}), **entry["injection"]}
        if isinstance(entry["magnitude"], Mapping):
            flat.update(entry["magnitude"])
        flat["activation"] = entry["activation"]["activation"]
        flat["bits"] = " ".join(str(bit) for bit in flat.get("bits", ()))
        yield ["" if flat.get(name) is None else str(flat[name]) for name in columns]


# -- workers

_Task = tuple[int, InstructionFault | None]
_CHUNK = 32  # tasks that are handed over at once


@contextmanager
def one_processor() -> Iterator[None]:
    """Tracer and target hand over to each other all the time: fastest on one processor."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [max(before)])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


class _Open:
    """What a worker process keeps between chunks: one target."""

    stream: tuple[str, ...] | None = None
    attacker: Attacker[Any] | None = None

    @classmethod
    def of(cls, bench: Bench) -> Attacker[Any]:
        """The attacker of a bench: the one that is open, or a new one in its place."""
        if cls.attacker is None or cls.stream != bench.stream:
            cls.keep(bench, bench.open())
        assert cls.attacker is not None
        return cls.attacker

    @classmethod
    def keep(cls, bench: Bench, attacker: Attacker[Any]) -> None:
        """Keep an attacker open for what comes, and close the one before."""
        cls.close()
        cls.attacker, cls.stream = attacker, bench.stream

    @classmethod
    def close(cls) -> None:
        """Close what is open, if anything is."""
        if cls.attacker is not None:
            cls.attacker.place.close()
            cls.attacker = None


def _work(job: tuple[Bench, Sequence[_Task]]) -> list[tuple[int, RunResult[Any]]]:
    bench, tasks = job
    attacker, results = _Open.of(bench), []
    for index, fault in tasks:
        if fault is not None:
            results.append((index, attacker.run(fault)))
        else:
            timed = attacker.run_timed(bench.plan.strategy(), _generator(bench, index))
            results.append((index, timed))
    return results


def _settle(queue: Any) -> None:
    os.sched_setaffinity(0, [queue.get()])


class Workers:
    """Worker processes, or this process where one is enough; a context, of one plan."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
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
        _Open.close()
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def take(self, bench: Bench, attacker: Attacker[Any]) -> None:
        """Take over what was prepared in this process; what no worker here needs is closed."""
        if self._pool is None:
            _Open.keep(bench, attacker)
        else:
            attacker.place.close()

    def run(self, bench: Bench, tasks: Sequence[_Task]) -> Iterator[tuple[int, RunResult[Any]]]:
        """The results in the order of the tasks.

        Raises:
            FaultError: a worker was killed.
        """
        size = max(1, min(_CHUNK, len(tasks) // (4 * self._jobs)))
        jobs = [(bench, tasks[at : at + size]) for at in range(0, len(tasks), size)]
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
