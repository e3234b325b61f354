"""Which instructions one invocation of a mission's kernel executes, found without flying.

A node is a function of its orders. The orders of the golden flight are given again to a node of
its own, at the speed of the machine, which is counted, and stepped at the invocation asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from mavfi_cli.core.errors import FaultError, TargetError
from mavfi_cli.fi.isolated.profile import Stratum, TargetProfile
from mavfi_cli.fi.native import linux
from mavfi_cli.fi.native.fault import Stage
from mavfi_cli.fi.native.image import Image, scope_of
from mavfi_cli.fi.native.node import (
    EntryCounter,
    InvocationProfile,
    count_executions,
    profile_invocation,
)
from mavfi_cli.fi.native.profile import Profile, Segment, record_window
from mavfi_cli.fi.native.tracee import Tracee
from mavfi_cli.fi.native.tracer import TracerThread
from mavfi_cli.mission.companion.node_process import NodeProcess
from mavfi_cli.mission.instruction.rehearsal import WHOLE_LIMIT, profile_request
from mavfi_cli.mission.instruction.scope import KernelScope
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.instruction.spawned_node import SpawnedNode

T = TypeVar("T")
Order = tuple[Any, float]  # input, start stamp
Armed = Callable[[], None]
_WINDOWS = {"octomap": 16}  # always sampled, and how many windows: of some 300 instructions


def count_entries(setup: Setup, orders: Sequence[Order]) -> list[int]:
    """How often the kernel had been entered after each order.

    Raises:
        TracingForbidden: the operating system neither counts nor lets us trace.
    """
    spawned, counter = SpawnedNode(), None
    counts = []
    try:
        scope = spawned.begin(setup)
        address = Image(spawned.pid, scope.regions).address(scope.entry)
        counter = EntryCounter(spawned.pid, address)
        process = NodeProcess(spawned.connection, spawned.pid)
        for value, start_s in orders:
            process.take(process.order(setup.node, value, start_s))
            counts.append(counter.read())
    finally:
        if counter is not None:
            counter.close()
        spawned.kill()
    return counts


def profile_kernel(
    setup: Setup, orders: Sequence[Order], entry: int, rng: np.random.Generator
) -> TargetProfile:
    """Profile one invocation of the kernel, which happens in the last of the orders.

    Args:
        setup: of the node.
        orders: up to the one with the invocation.
        entry: how many entries of the kernel there have been when it begins, itself included.
        rng: draws what is stepped, where that is a sample.

    Raises:
        WindowTooLong: too long to be stepped, and without inner functions.
        TargetError: nothing in scope executes.
    """
    if setup.node == "planner":
        return profile_request(setup, orders, entry, rng)
    if setup.node in _WINDOWS:
        return _sampled(setup, orders, entry, _WINDOWS[setup.node], rng)
    return _whole(setup, orders, entry)


def _traced(
    setup: Setup, orders: Sequence[Order], work: Callable[[int, KernelScope, Armed], T]
) -> T:
    """Let a node work on the orders while a tracer does its own work on it."""
    spawned = SpawnedNode()
    try:
        scope = spawned.begin(setup)

        def trace(armed: Armed) -> T:
            """On the node's own processor: handing over between two would cost as much again."""
            linux.share_processor(spawned.pid)
            return work(spawned.pid, scope, armed)

        tracer = TracerThread(trace)
        tracer.await_armed()
        process = NodeProcess(spawned.connection, spawned.pid)
        for value, start_s in orders[:-1]:
            process.take(process.order(setup.node, value, start_s))
        process.order(setup.node, *orders[-1])
        return tracer.result()
    finally:
        spawned.kill()


def _whole(setup: Setup, orders: Sequence[Order], invocation: int) -> TargetProfile:
    def work(pid: int, scope: KernelScope, armed: Armed) -> InvocationProfile:
        """Step through the whole invocation."""
        return profile_invocation(
            pid,
            scope.entry,
            invocation,
            objects=scope.objects,
            regions=scope.regions,
            limit=WHOLE_LIMIT,
            armed=armed,
        )

    found = _traced(setup, orders, work)
    return _of_windows([found], 1)


def _sampled(
    setup: Setup, orders: Sequence[Order], invocation: int, windows: int, rng: np.random.Generator
) -> TargetProfile:
    """Step some invocations of one function of the kernel, drawn by how often it runs."""
    counts = _traced(
        setup,
        orders,
        lambda pid, scope, armed: count_executions(
            pid, scope.entry, invocation, scope.inner, regions=scope.regions, armed=armed
        ),
    )
    total = sum(counts)
    if not total:
        raise FaultError(f"this invocation of {setup.node} calls none of its inner functions")
    which = int(np.searchsorted(np.cumsum(counts), rng.integers(total), side="right"))
    number = min(windows, counts[which])
    drawn = sorted(1 + rng.choice(counts[which], size=number, replace=False))

    def work(pid: int, scope: KernelScope, armed: Armed) -> list[InvocationProfile]:
        """Step through the drawn windows."""
        return _windows(pid, scope, invocation, which, [int(m) for m in drawn], armed)

    found = _traced(setup, orders, work)
    return _of_windows(found, total)


def _of_windows(found: Sequence[InvocationProfile], windows_in_run: int) -> TargetProfile:
    segments = tuple(each.segment for each in found)
    profile = Profile(segments=segments, windows_in_run=windows_in_run, cost_s=0.0)
    return TargetProfile(
        strata=(Stratum(marker=segments[0].start[-1].location, profile=profile),),
        image=found[0].image,
        code=found[0].code,
        cost_s=0.0,
    )


def _windows(
    pid: int, scope: KernelScope, invocation: int, which: int, drawn: list[int], armed: Armed
) -> list[InvocationProfile]:
    tracee = Tracee.attach(pid)
    found = []
    try:
        image = Image(pid, scope.regions)
        spans = scope_of(image, scope.objects)
        code = tuple((s.start, tracee.read_memory(s.start, len(s) + 16)) for s in spans.spans)
        armed()
        start = Stage(scope.entry, invocation)
        _reach(tracee, image, start)
        passed = 0
        for number in drawn:
            inner = Stage(scope.inner[which], number)
            _reach(tracee, image, Stage(inner.location, number - passed))
            passed = number
            trace = record_window(
                tracee, spans, limit=WHOLE_LIMIT, program=f"node {pid}", until_return=True
            )
            segment = Segment(start=(start, inner), trace=trace)
            found.append(InvocationProfile(segment=segment, image=image, code=code))
    finally:
        if tracee.ended is None:
            tracee.detach()
    return found


def _reach(tracee: Tracee, image: Image, stage: Stage) -> None:
    if not tracee.run_to(image.address(stage.location), stage.count):
        raise TargetError(f"node {tracee.pid}", f"ended before {stage.location}")
