"""Which instructions one invocation of a mission's kernel executes, found without flying.

A node is a function of its orders. The orders of the golden flight are given again to a node of
its own, at the speed of the machine, which is counted, and stepped at the invocation asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from mavfi_cli.core.errors import FaultError, TargetError
from mavfi_cli.fi.native import linux
from mavfi_cli.fi.native.fault import Stage
from mavfi_cli.fi.native.image import Image, scope_of
from mavfi_cli.fi.native.node import (
    EntryCounter,
    InvocationProfile,
    count_executions,
    profile_invocation,
)
from mavfi_cli.fi.native.profile import Profile, Segment, WindowTooLong, record_window
from mavfi_cli.fi.native.tracee import Tracee
from mavfi_cli.fi.native.tracer import TracerThread
from mavfi_cli.mission.kernel_scope import KernelScope, kernel_of_node
from mavfi_cli.mission.node_process import NodeProcess
from mavfi_cli.mission.node_server import Setup
from mavfi_cli.mission.spawned_node import SpawnedNode

T = TypeVar("T")
Order = tuple[Any, float]  # input, start stamp
Armed = Callable[[], None]
WHOLE_LIMIT = 600_000  # instructions; more are sampled, where the kernel has inner functions
# Always sampled, and how many windows: of some 300 instructions in OctoMap, 40,000 in RRT*.
_WINDOWS = {"octomap": 16, "rrtstar": 4}
_OTHER_WINDOWS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelProfile:
    """What was executed, and what is needed to draw from it."""

    profile: Profile
    first: InvocationProfile  # any window: image and code
    windows: str  # how many of how many


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
    setup: Setup, orders: Sequence[Order], invocation: int, rng: np.random.Generator
) -> KernelProfile:
    """Profile one invocation of the kernel, which happens in the last of the orders.

    Raises:
        TargetError: too long to be stepped, and without inner functions.
    """
    kernel = kernel_of_node(setup.node, setup.config.planner)
    if kernel not in _WINDOWS:
        try:
            return _whole(setup, orders, invocation)
        except WindowTooLong as error:
            if setup.node != "planner":
                raise error
    return _sampled(setup, orders, invocation, _WINDOWS.get(kernel, _OTHER_WINDOWS), rng)


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


def _whole(setup: Setup, orders: Sequence[Order], invocation: int) -> KernelProfile:
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
    profile = Profile(segments=(found.segment,), windows_in_run=1, cost_s=0.0)
    return KernelProfile(profile=profile, first=found, windows="1 of 1")


def _sampled(
    setup: Setup, orders: Sequence[Order], invocation: int, windows: int, rng: np.random.Generator
) -> KernelProfile:
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
    profile = Profile(
        segments=tuple(each.segment for each in found), windows_in_run=total, cost_s=0.0
    )
    return KernelProfile(profile=profile, first=found[0], windows=f"{number} of {total}")


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
