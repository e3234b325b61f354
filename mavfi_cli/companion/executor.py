"""Executor of nodes that run concurrently in simulated time, like ROS nodes.

A node runs one kernel. Its input queue has length one: a newer input replaces a waiting one. An
invocation that starts at `t` occupies the node and one core of the platform until `t` plus its
latency. Its output takes effect at that time. The computation itself may happen at any host time in
between, so the vehicle's simulation need not wait for it.

A turn is a coroutine that uses the outputs of nodes and awaits one node after another:
`cloud = await point_cloud.run(frame)` continues when the cloud takes effect. If the frame was
replaced or lost, it never continues.

Nodes that share a process run one after another in the listed order, each with its newest input.
If one of them fails, the whole process ends, and the waiting inputs of the other nodes are lost.

A node in its own process may die from a signal or from an error in its kernel. Its current input is
then lost, and the node restarts with fresh state one restart time after its output was due. A node
that hangs stays busy until the watchdog kills it. The times of these events depend only on how the
process ended, never on when the host noticed it, so they are repeatable.
"""

from __future__ import annotations

import functools
import heapq
import math
import types
from collections.abc import Callable, Coroutine, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from mavfi_cli.companion.node_process import NodeLost, NodeProcess
from mavfi_cli.core.flight_record import MeasuredKernel, MeasuredPlatform
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import KERNELS, Invocation
from mavfi_cli.core.wall import WallClock
from mavfi_cli.spec.platform import PlatformProfile

In = TypeVar("In")
Out = TypeVar("Out")
AnyNode: TypeAlias = "Node[Any, Any]"
Turn: TypeAlias = "Coroutine[tuple[AnyNode, Any], Any, None]"
_SAME_S = 1e-9


class LatencyModel:
    """Draws the latency of each invocation from a platform profile.

    Each kernel has its own random stream, so the number of calls of one kernel never changes the
    latencies of another. On a measured platform the latency is the host time of the kernel's newest
    invocation times the profile's factor.
    """

    def __init__(
        self, profile: PlatformProfile, root_seed: int, wall: WallClock | None = None
    ) -> None:
        self._profile, self._wall = profile, wall
        self._streams = {kernel: Stream.LATENCY.generator(root_seed, kernel) for kernel in KERNELS}
        self._host_s: dict[str, list[float]] = {kernel: [] for kernel in KERNELS}

    def draw_s(self, kernel: str) -> float:
        """Return the latency of a kernel's next invocation, in seconds.

        On a measured platform, return that of its newest invocation instead.
        """
        if self._profile.measured_factor is not None:
            assert self._wall is not None
            host_s = self._wall.newest.get(kernel, 0.0)
            self._host_s[kernel].append(host_s)
            return self._profile.measured_factor * host_s
        latency, drawn = self._profile.kernels[kernel], self._streams[kernel].standard_normal()
        return latency.latency_s * math.exp(latency.spread * float(drawn))

    def summary(self) -> MeasuredPlatform | None:
        """Return the factor and the median kernel times (in seconds) of a measured platform.

        Return None if the platform's latencies are not measured in flight.
        """
        factor = self._profile.measured_factor
        if factor is None:
            return None
        kernels = {
            kernel: MeasuredKernel(
                host_median_s=(median_s := float(np.median(times_s))),
                latency_median_s=factor * median_s,
                invocations=len(times_s),
            )
            for kernel, times_s in self._host_s.items()
            if times_s
        }
        return MeasuredPlatform(platform=self._profile.name, factor=factor, kernels=kernels)


class TurnOver(Exception):
    """Raised inside a turn to end it before its last node has run."""


@dataclass(slots=True, eq=False)
class Node(Generic[In, Out]):
    """A node of the executor: its kernel, its input queue of length one, and its process."""

    name: str
    kernel: Callable[[In, float], Out]
    on_start: Callable[[In, float], None] = lambda _input, _start_s: None
    before_restart: Callable[[], None] = lambda: None  # prepares the state of the new process
    on_restart: Callable[[], None] = lambda: None
    pending: tuple[In, Turn] | None = None  # waiting input and the turn that it belongs to
    busy: bool = False
    invocations: int = 0
    dropped: int = 0  # inputs replaced by a newer one before they were read
    busy_s: float = 0.0
    process: NodeProcess | None = None  # process that runs the kernel; None: this process
    restarts: int = 0
    free_s: float = 0.0  # end of the newest invocation by `Executor.call`
    mates: list[AnyNode] = field(default_factory=list)  # others in its process, in cyclic order
    standby: bool = False  # this process's kernel also runs on every input, to take over

    @types.coroutine
    def run(self, value: In) -> Generator[tuple[AnyNode, In], Out, Out]:
        """Submit an input to the node. Return the output when it takes effect."""
        return (yield self, value)


@dataclass(slots=True, eq=False)
class _Job:
    """One invocation of a node's kernel, from its start until its output takes effect."""

    node: AnyNode
    start_s: float
    input: Any
    turn: Turn | None = None
    order: int | None = None  # number of the request to the node's process
    done: bool = False
    cancelled: bool = False  # True if its process was killed before the output was due
    output: Any = None

    def begin(self, wall: WallClock) -> None:
        """Run the kernel, or send the input to the node's process. Later calls do nothing."""
        if self.done or self.order is not None:
            return
        process = self.node.process
        if process is None:
            with wall.measure(self.node.name):
                self.output = self.node.kernel(self.input, self.start_s)
            self.done = True
        else:
            self.order = process.order(self.node.name, self.input, self.start_s)
        if not self.node.standby:
            self.input = None

    def settle(self, wall: WallClock) -> NodeLost | None:
        """Wait for the output. If the node's process was lost, return the loss, otherwise None."""
        self.begin(wall)
        if not self.done:
            assert self.node.process is not None
            assert self.order is not None
            try:
                self.output, host_s = self.node.process.take(self.order)
            except NodeLost as loss:
                return loss
            wall.add(self.node.name, host_s)
            self.done = True
            if self.node.standby:
                self.node.kernel(self.input, self.start_s)
        return None


@dataclass(slots=True)
class Executor:
    """Runs nodes concurrently in simulated time, on a limited number of cores.

    Attributes:
        draw_latency_s: Function that returns the latency, in seconds, of the next invocation of
            the node with the given name.
        cores: Maximum number of nodes that run at once; others wait in the order of their requests.
        compute_first: Start an invocation's computation before its latency is drawn.
        restart_s: Simulated time, in seconds, from the end of a node's process until the new one is
            ready.
        watchdog_s: Simulated time, in seconds, after which an unfinished invocation is killed.
        on_start: Called at the start of each invocation, with the node's name, the input and the
            stamp.
        losses: The lost processes so far.
        timetable: The invocations so far, in order of start.
    """

    draw_latency_s: Callable[[str], float]
    cores: int
    wall: WallClock = field(default_factory=WallClock)
    compute_first: bool = False
    restart_s: float = 1.0
    watchdog_s: float = 5.0
    on_start: Callable[[str, Any, float], None] = lambda _node, _input, _start_s: None
    now_s: float = 0.0
    nodes: dict[str, AnyNode] = field(default_factory=dict)
    losses: list[NodeLost] = field(default_factory=list)
    timetable: list[Invocation] = field(default_factory=list)
    _events: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)  # a heap
    _waiting: list[AnyNode] = field(default_factory=list)
    _uncomputed: list[_Job] = field(default_factory=list)
    _jobs: dict[str, _Job] = field(default_factory=dict)  # jobs with a pending output
    _working: int = 0
    _count: int = 0

    def add(self, node: Node[In, Out]) -> Node[In, Out]:
        """Add a node and return it. Its name selects the latency of its invocations."""
        self.nodes[node.name] = node
        return node

    def share_process(self, names: Sequence[str]) -> None:
        """Let the named nodes share one single-threaded process, which runs them in this order."""
        nodes = [self.nodes[name] for name in names]
        for place, node in enumerate(nodes):
            node.mates = nodes[place + 1 :] + nodes[:place]

    def stand_by(self, names: Sequence[str]) -> None:
        """Give the process of each named node a hot standby.

        The standby also processes every input, so it has the same state as the process. When the
        process dies or hangs, the standby's output takes effect instead, at the same time.
        """
        for name in names:
            for node in (self.nodes[name], *self.nodes[name].mates):
                node.standby = True

    def process_of(self, name: str) -> dict[str, Callable[[Any, float], Any]]:
        """Return the kernels of a node and of the nodes that share its process, by node name."""
        node = self.nodes[name]
        return {member.name: member.kernel for member in (node, *node.mates)}

    def isolate(self, name: str, process: NodeProcess | None = None) -> None:
        """Run a node, and the nodes that share its process, in a separate process until `close`.

        Args:
            process: Process that runs the kernels of these nodes. By default it is a fork of this
                process, with a copy of their state.
        """
        node = self.nodes[name]
        node.process = process or NodeProcess.fork(self.process_of(name))
        for mate in node.mates:
            mate.process = node.process

    def isolate_late(
        self,
        name: str,
        fresh: Mapping[str, Callable[[Any, float], Any]],
        process: NodeProcess | None = None,
    ) -> None:
        """Move a node that has already run to a separate process, as `isolate` does.

        Args:
            fresh: Kernels that have never run, by node name. A lost process restarts with these. A
                hot standby keeps the kernels that have already run.
            process: As for `isolate`.
        """
        self.isolate(name, process)
        for node, kernel in fresh.items():
            if not self.nodes[node].standby:
                self.nodes[node].kernel = kernel

    # Turns

    def start(self, turn: Turn) -> None:
        """Begin a turn at the current simulated time."""
        self._go_on(turn, None)

    def _go_on(self, turn: Turn, output: Any) -> None:
        """Continue a turn with a node's output, and submit its next input to the node it awaits."""
        try:
            node, value = turn.send(output)
        except (StopIteration, TurnOver):
            return
        if node.pending is not None:
            node.dropped += 1
        node.pending = value, turn
        self._start_if_free(node)

    def call(
        self, node: Node[In, Out], value: In, *, again: bool = False
    ) -> tuple[Out, float] | None:
        """Run a node at once, outside the queue and without using a core of the platform.

        Args:
            again: Repeat the newest invocation even if it has not ended. Other calls are dropped
                until then.

        Returns:
            The output, and the latency in seconds until it takes effect. None if the node is busy
            or down, or if its process is lost during this call.
        """
        if node.busy or (self.now_s < node.free_s - _SAME_S and not again):
            node.dropped += 1
            return None
        job = self._begin_job(node, value)
        lost = job.settle(self.wall)
        latency_s = self._book(job)
        node.free_s = max(node.free_s, self.now_s + latency_s)
        if lost is None:
            return job.output, latency_s
        node.busy = True
        gone_s = self.now_s + self.watchdog_s if lost.hung else self.now_s
        self._note_loss(node, gone_s, lost)
        self._at(gone_s + self.restart_s, self._restart, node)
        return None

    # Time

    def advance(self, stamp_s: float) -> None:
        """Apply all outputs due by `stamp_s`, in chronological order."""
        while self._events and self._events[0][0] <= stamp_s:
            due_s, _, event = heapq.heappop(self._events)
            self.now_s = max(self.now_s, due_s)
            event()
        self.now_s = max(self.now_s, stamp_s)

    def compute(self) -> None:
        """Begin to compute the outputs of all started invocations. May be called at any time."""
        while self._uncomputed:
            self._uncomputed.pop(0).begin(self.wall)

    def _at(self, stamp_s: float, event: Callable[..., None], *about: Any) -> None:
        due: Callable[[], None] = functools.partial(event, *about)
        heapq.heappush(self._events, (stamp_s, self._count, due))
        self._count += 1

    def _start_if_free(self, node: AnyNode) -> None:
        if node.busy or node.pending is None or any(mate.busy for mate in node.mates):
            return
        if self._working >= self.cores:
            if node not in self._waiting:
                self._waiting.append(node)
            return
        (value, turn), node.pending = node.pending, None
        node.busy = True
        job = self._begin_job(node, value)
        job.turn = turn
        if self.compute_first:
            job.begin(self.wall)
        latency_s = self._book(job)
        self._working += 1
        self._uncomputed.append(job)
        self._jobs[node.name] = job
        self._at(self.now_s + latency_s, self._finish, job)

    def _begin_job(self, node: AnyNode, value: Any) -> _Job:
        node.invocations += 1
        node.on_start(value, self.now_s)
        self.on_start(node.name, value, self.now_s)
        return _Job(node=node, start_s=self.now_s, input=value)

    def _book(self, job: _Job) -> float:
        """Draw an invocation's latency, add the invocation to the timetable, return the latency."""
        latency_s = self.draw_latency_s(job.node.name)
        job.node.busy_s += latency_s
        end_s = job.start_s + latency_s
        self.timetable.append(Invocation(node=job.node.name, start_s=job.start_s, end_s=end_s))
        return latency_s

    def _finish(self, job: _Job) -> None:
        if job.cancelled:
            return
        self._jobs.pop(job.node.name, None)
        if (loss := job.settle(self.wall)) is not None:
            if not job.node.standby:
                self._lose(job, loss)
                return
            self._take_over(job.node, loss)
            job.output = job.node.kernel(job.input, job.start_s)
        job.node.busy = False
        assert job.turn is not None
        self._go_on(job.turn, job.output)  # its core is still busy, so new invocations queue last
        self._start_next(job.node)
        self._free_cores(1)

    def _start_next(self, node: AnyNode) -> None:
        """Start the next node in this node's process that has an input waiting."""
        for member in (*node.mates, node):
            self._start_if_free(member)

    def _free_cores(self, number: int) -> None:
        self._working -= number
        while self._waiting and self._working < self.cores:
            self._start_if_free(self._waiting.pop(0))

    # Ends of processes

    def settle(self) -> None:
        """Wait for all node processes to answer, so that the host's speed cannot affect a fault."""
        for job in self._jobs.values():
            if job.order is not None:
                job.settle(self.wall)
        self._jobs.clear()

    def close(self) -> None:
        """End the processes of all nodes."""
        for node in self.nodes.values():
            if node.process is not None:
                node.process.close(kill=True)
                node.process = None

    def kill(self, name: str) -> None:
        """Treat the process of a node as killed by SIGKILL. Do nothing if it is already down.

        Unless the node has a hot standby, its current input is lost, as in a crash. After the
        restart, the node continues with its newest waiting input.
        """
        node = self.nodes[name]
        members = (node, *node.mates)
        jobs = [self._jobs[member.name] for member in members if member.name in self._jobs]
        if not jobs and any(member.busy for member in members):
            return
        loss = NodeLost(hung=False, how="killed by SIGKILL")
        if node.standby:
            for job in jobs:
                job.settle(self.wall)
            self._take_over(node, loss)
            return
        for job in jobs:
            del self._jobs[job.node.name]
            if job.order is not None:  # the result must not depend on the host's progress
                job.settle(self.wall)
            job.cancelled = True
        node.busy = True
        self._note_loss(node, self.now_s, loss)
        self._at(self.now_s + self.restart_s, self._restart, node)
        self._free_cores(len(jobs))

    def _take_over(self, node: AnyNode, loss: NodeLost) -> None:
        """Replace a lost process with its standby, which has processed all earlier inputs."""
        loss.node, loss.stamp_s = node.name, self.now_s
        self.losses.append(loss)
        if node.process is not None:
            node.process.close(kill=True)
        for member in (node, *node.mates):
            member.process, member.standby = None, False

    def _lose(self, job: _Job, loss: NodeLost) -> None:
        """Handle a lost output: the node stays busy until its process has ended and restarted."""
        end_s = self.now_s
        gone_s = max(end_s, job.start_s + self.watchdog_s) if loss.hung else end_s
        job.node.busy_s += gone_s - end_s
        self._note_loss(job.node, gone_s, loss)
        self._at(gone_s, self._end_process, job.node)

    def _note_loss(self, node: AnyNode, gone_s: float, loss: NodeLost) -> None:
        loss.node, loss.stamp_s = node.name, gone_s
        self.losses.append(loss)
        for mate in node.mates:
            mate.pending = None

    def _end_process(self, node: AnyNode) -> None:
        self._at(self.now_s + self.restart_s, self._restart, node)
        self._free_cores(1)

    def _restart(self, node: AnyNode) -> None:
        """Fork a new process for a node, and for the nodes that shared its lost process.

        Its state is fresh, because its kernels never ran in this process.
        """
        if node.process is not None:
            node.process.close(kill=True)
        members = (node, *node.mates)
        for member in members:
            member.before_restart()
        process = NodeProcess.fork(self.process_of(node.name))
        for member in members:
            member.process = process
            member.restarts += 1
            member.busy = False
        for member in members:
            member.on_restart()
        self._start_next(node)
