"""A node of a mission as a target: it repeats one of its orders without a flight.

A node is a function of its orders. A separate node gets the orders of the golden run again, at the
speed of the machine. It forks for the last of them as often as it is asked: each fork works on the
order and ends instead of answering.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mavfi_cli.attack.attacker import EntryCounter, TracerThread
from mavfi_cli.attack.kernels.scope import KernelScope
from mavfi_cli.attack.profile import profile_call, profile_calls, profile_run
from mavfi_cli.attack.served import served_process
from mavfi_cli.attack.target import TargetProfile
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.fault import CountedStop
from mavfi_cli.fi.tracer.image import Image, Scope, scope_of
from mavfi_cli.fi.tracer.sampling import WindowTooLong
from mavfi_cli.fi.tracer.tracee import Tracee
from mavfi_cli.mission.instruction import PROGRAM
from mavfi_cli.mission.instruction.server import Setup

Order = tuple[Any, float]  # input, start stamp
WHOLE_LIMIT = 600_000  # instructions of an invocation, or of one window
WINDOWS, ENOUGH = 4, 50_000  # for a planner's request with a search: see `profile_run`
_CALLS = {"octomap": 16}  # sampled calls of one inner function, about 300 instructions each


class Rehearsal:
    """The `AttackPlace` in which one invocation of a node's kernel runs.

    Args:
        orders: inputs and start stamps, up to the order with the invocation.
        entry: number of the kernel's entry in that order with which it begins, from 1.
    """

    kind = "node"

    def __init__(self, setup: Setup, orders: Sequence[Order], entry: int = 1) -> None:
        self._setup, self._entry = setup, entry
        self._last = orders[-1]
        self._spawned = served_process(PROGRAM)
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            self.scope_of_node: KernelScope = self._spawned.begin(setup, f"node {setup.node}")
            self._process = NodeProcess(self._spawned.connection, self._spawned.pid)
            for value, start_s in orders[:-1]:
                self._process.take(self._process.order(setup.node, value, start_s))
            self._image = Image(self._spawned.pid, self.scope_of_node.regions)
            undo.pop_all()

    @property
    def name(self) -> str:
        """Name of the kernel."""
        return self.scope_of_node.kernel

    def start(self) -> Tracee:
        """Start a fork of the node, stopped where it begins the invocation."""
        tracee = Tracee.attach(self._process.rehearse())
        self._process.order(self._setup.node, *self._last)
        if not tracee.run_to(self._image.address(self.scope_of_node.entry), self._entry):
            raise TargetError(f"node {self._setup.node}", "does not begin its invocation again")
        return tracee

    def image(self, _: Tracee) -> Image:
        """The memory image of the node and of each fork."""
        return self._image

    def scope(self, image: Image) -> Scope:
        """The code that may be hit."""
        return scope_of(image, self.scope_of_node.objects)

    def profile(self, rng: np.random.Generator) -> TargetProfile:
        """Step the invocation, or a sample of it.

        It runs on the node's own processor: switching between two doubles the time.
        """
        linux.share_processor(self._spawned.pid)
        node, inner = self._setup.node, self.scope_of_node.inner
        if node == "planner":
            return self._profile_request(rng)
        if node in _CALLS:
            return profile_calls(self, rng, inner, windows=_CALLS[node], limit=WHOLE_LIMIT)
        return profile_call(self, limit=WHOLE_LIMIT)

    def _profile_request(self, rng: np.random.Generator) -> TargetProfile:
        """Step a whole request if it needs no search, else a sample of it.

        No native function encloses a request: Python calls several compiled functions, with or
        without a search. So the request ends with the run.
        """
        if not self._searches():
            try:
                return profile_run(self, rng, limit=WHOLE_LIMIT)
            except WindowTooLong:  # smoothing repeats its attempts
                pass
        return profile_run(
            self,
            rng,
            markers=self.scope_of_node.inner,
            windows=WINDOWS,
            enough=ENOUGH,
            limit=WHOLE_LIMIT,
        )

    def _searches(self) -> bool:
        tracee = self.start()
        try:
            search = self.scope_of_node.inner[0]
            return tracee.count_to_end(self._image.address(search)) > 0
        finally:
            tracee.kill()

    def close(self) -> None:
        """End the node."""
        self._spawned.kill()


def profile_invocation(
    setup: Setup, orders: Sequence[Order], entry: int, earlier: int, rng: np.random.Generator
) -> TargetProfile:
    """Profile one invocation of a node's kernel in the last of the orders.

    Args:
        orders: the orders up to the one with the invocation.
        entry: number of the kernel's entries when it begins, itself included.
        earlier: number of them in the earlier orders.
        rng: draws the sample, if only a sample is stepped.

    Raises:
        TracingForbidden: the operating system refuses.
        WindowTooLong: the invocation is too long to be stepped.
        TargetError: nothing in scope executes.
    """
    place = Rehearsal(setup, orders, entry - earlier)
    try:
        found = TracerThread(lambda _armed: place.profile(rng)).result()
    finally:
        place.close()
    return found.after(CountedStop(place.scope_of_node.entry, entry))


def count_entries(setup: Setup, orders: Sequence[Order]) -> list[int]:
    """Count the kernel's entries up to the end of each order.

    Raises:
        TracingForbidden: the operating system neither counts nor lets us trace.
    """
    spawned, counts = served_process(PROGRAM), []
    with contextlib.ExitStack() as leaving:
        leaving.callback(spawned.kill)
        scope = spawned.begin(setup, f"node {setup.node}")
        address = Image(spawned.pid, scope.regions).address(scope.entry)
        counter = leaving.enter_context(contextlib.closing(EntryCounter(spawned.pid, address)))
        process = NodeProcess(spawned.connection, spawned.pid)
        for value, start_s in orders:
            process.take(process.order(setup.node, value, start_s))
            counts.append(counter.read())
    return counts
