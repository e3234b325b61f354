"""Worker processes that keep a target open and run its faults in order."""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from mavfi_cli.attack.attacker import Attacker, RunResult
from mavfi_cli.attack.plan import Plan
from mavfi_cli.attack.target import AttackTarget, Golden
from mavfi_cli.core.errors import FaultError, TargetError
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.fi.tracer.fault import InstructionFault

_CHUNK = 32  # tasks that are sent at once
Task = tuple[int, InstructionFault | None]  # number, and the fault; None: drawn at its moment


@contextmanager
def one_processor() -> Iterator[None]:
    """Stay on one processor: tracer and target switch all the time, which is fastest there."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [max(before)])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A target with its golden run, as plain values for a worker process."""

    plan: Plan
    target: AttackTarget
    golden: Golden

    def generator(self, *what: str | int) -> np.random.Generator:
        """The target's own random numbers; those of fault number i depend on i only."""
        return generator(self.plan.seed, Stream.FAULT, *self.target.stream, *what)


class _Open:
    """The one target that a worker process keeps open between chunks."""

    stream: tuple[str, ...] | None = None
    attacker: Attacker | None = None

    @classmethod
    def of(cls, bench: Bench) -> Attacker:
        """The attacker of a bench: the open one, or a new one in its place."""
        if cls.attacker is None or cls.stream != bench.target.stream:
            cls.keep(bench, Attacker(place=bench.target.open(), golden=bench.golden))
        assert cls.attacker is not None
        return cls.attacker

    @classmethod
    def keep(cls, bench: Bench, attacker: Attacker) -> None:
        """Keep an attacker open for later chunks, and close the previous one."""
        cls.close()
        cls.attacker, cls.stream = attacker, bench.target.stream

    @classmethod
    def close(cls) -> None:
        """Close the open attacker, if there is one."""
        if cls.attacker is not None:
            cls.attacker.place.close()
            cls.attacker = None


def _work(job: tuple[Bench, Sequence[Task]]) -> list[tuple[int, RunResult]]:
    bench, tasks = job
    attacker, results = _Open.of(bench), []
    for index, fault in tasks:
        if fault is not None:
            results.append((index, attacker.run(fault)))
        else:
            timed = attacker.run_timed(bench.plan.strategy(), bench.generator(index))
            results.append((index, timed))
    return results


def _settle(queue: Any) -> None:
    os.sched_setaffinity(0, [queue.get()])


class AttackWorkers:
    """The workers of one campaign, or this process if one is enough; a context manager."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> AttackWorkers:
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

    def take(self, bench: Bench, attacker: Attacker) -> None:
        """Keep an attacker prepared in this process, or close it if no worker here needs it."""
        if self._pool is None:
            _Open.keep(bench, attacker)
        else:
            attacker.place.close()

    def run(self, bench: Bench, tasks: Sequence[Task]) -> Iterator[tuple[int, RunResult]]:
        """The results in the order of the tasks.

        Raises:
            FaultError: something killed a worker.
            TargetError: the target cannot be sent to a worker.
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
            pickle.dumps(bench)
        except Exception as error:  # the target may raise anything
            problem = f"cannot be handed to a worker process: {error}"
            raise TargetError(bench.target.name, problem) from None
        try:
            for results in self._pool.map(_work, jobs):
                yield from results
        except BrokenProcessPool:
            raise FaultError("a worker process was killed; the campaign is incomplete") from None
