"""Executor of nodes that run concurrently in simulated time, like ROS nodes.

A node runs one kernel. Its input queue has length one: a newer input replaces a waiting one. An
invocation that starts at `t` occupies the node and one core of the platform until `t` plus its
latency. Its output is published at that time. The computation itself happens at any host time in
between, so the vehicle's simulation need not wait for it.

Nodes that share a process run one after the other in the listed order, each with its newest input.
They end together, and all their waiting inputs are lost.

A node in its own process may die from a signal or from an error in its kernel. Its present input is
lost. It restarts with fresh state one restart time after its output was due. A node that hangs
stays busy until the watchdog kills it. Both depend only on how the process ended, never on when the
host noticed it, so they are repeatable.
"""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mavfi_cli.core.wall import WallClock
from mavfi_cli.mission.companion.node_process import NodeLost, NodeProcess

Run = Callable[[Any, float], Any]  # (input, start stamp) -> output
Publish = Callable[[Any, float], None]  # (output, stamp at which it takes effect)
_Event = Callable[[float], None]
_SAME_S = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """Loss of a node's process."""

    node: str
    stamp_s: float  # due time of the output, or time of the watchdog's kill
    hung: bool
    how: str
    traceback: str = ""  # traceback of an error in the kernel


@dataclass(slots=True, eq=False)
class Node:
    """A node: its kernel, the consumer of its output, and its queue of length one."""

    name: str
    run: Run
    publish: Publish
    on_restart: Callable[[Node], None]
    pending: Any = None
    busy: bool = False
    invocations: int = 0
    dropped: int = 0  # inputs replaced by a newer one before they were read
    busy_s: float = 0.0
    process: NodeProcess | None = None  # process that runs the kernel; None for this one
    losses: list[Loss] = field(default_factory=list)
    restarts: int = 0
    finished: int = 0  # completed or failed invocations
    free_s: float = 0.0  # end of the newest invocation outside the queue
    mates: list[Node] = field(default_factory=list)  # others in its process, in cyclic order


@dataclass(slots=True, eq=False)
class _Job:
    """An invocation between its start and the publication of its output."""

    node: Node
    start_s: float
    input: Any
    order: int | None = None  # number of the request to the node's process
    done: bool = False
    cancelled: bool = False  # True if its process was killed before the output was due
    output: Any = None

    def begin(self, wall: WallClock) -> None:
        """Run the kernel, or send the input to the node's process."""
        if self.done or self.order is not None:
            return
        process = self.node.process
        if process is None:
            with wall.measure(self.node.name):
                self.output = self.node.run(self.input, self.start_s)
            self.done = True
        else:
            self.order = process.order(self.node.name, self.input, self.start_s)
        self.input = None

    def settle(self, wall: WallClock) -> None:
        """Wait until the node's process has answered or died."""
        if self.order is not None and not self.done:
            with contextlib.suppress(NodeLost):
                self.result(wall)

    def result(self, wall: WallClock) -> Any:
        """Return the output and wait for it if necessary."""
        self.begin(wall)
        if not self.done:
            assert self.node.process is not None
            assert self.order is not None
            self.output, host_s = self.node.process.take(self.order)
            wall.add(self.node.name, host_s)
            self.done = True
        return self.output


@dataclass(frozen=True, slots=True, kw_only=True)
class Invocation:
    """A row of the timetable: node, start and end of an invocation."""

    node: str
    start_s: float
    end_s: float


@dataclass(slots=True)
class Executor:
    """Runs nodes in simulated time on a number of cores.

    Attributes:
        draw_latency_s: Function from a node's name to the latency of its next invocation, s.
        cores: Maximum number of concurrent nodes; the others wait in the order of their requests.
        compute_first: Draw an invocation's latency after its computation.
        restart_s: Simulated time from a node's end until its successor is ready, s.
        watchdog_s: Simulated time after which an unfinished invocation is killed, s.
        losses: Losses of all nodes, in order.
        timetable: All invocations in the order of their starts.
        on_start: Callback for every invocation with node, input and start stamp.
    """

    draw_latency_s: Callable[[str], float]
    cores: int
    wall: WallClock = field(default_factory=WallClock)
    compute_first: bool = False
    restart_s: float = 1.0
    watchdog_s: float = 5.0
    now_s: float = 0.0
    losses: list[Loss] = field(default_factory=list)
    on_start: Callable[[str, Any, float], None] = lambda _node, _input, _start_s: None
    timetable: list[Invocation] = field(default_factory=list)
    _nodes: dict[str, Node] = field(default_factory=dict)
    _events: list[tuple[float, int, _Event]] = field(default_factory=list)  # heap: time, order
    _waiting: list[Node] = field(default_factory=list)
    _uncomputed: list[_Job] = field(default_factory=list)
    _jobs: dict[str, _Job] = field(default_factory=dict)  # jobs with a pending output
    _working: int = 0
    _count: int = 0

    def add(
        self,
        name: str,
        run: Run,
        publish: Publish,
        on_restart: Callable[[Node], None] = lambda _node: None,
    ) -> Node:
        """Add a node.

        Args:
            name: Name of the node, which selects its latency.
            run: Kernel of the node.
            publish: Consumer of its output at the due time.
            on_restart: Callback after a restart, before the node reads its next input.
        """
        node = Node(name=name, run=run, publish=publish, on_restart=on_restart)
        self._nodes[name] = node
        return node

    def share_process(self, names: Sequence[str]) -> None:
        """Let nodes share one single-threaded process whose loop runs them in this order."""
        nodes = [self._nodes[name] for name in names]
        for place, node in enumerate(nodes):
            node.mates = nodes[place + 1 :] + nodes[:place]

    def process_of(self, name: str) -> dict[str, Run]:
        """Return the kernels in the process of a node, by node name."""
        node = self._nodes[name]
        return {each.name: each.run for each in (node, *node.mates)}

    def isolate(self, name: str, process: NodeProcess | None = None) -> None:
        """Run a node's kernel in a separate process from now on, until `close`.

        Args:
            name: Name of the node. Nodes that share its process move with it.
            process: Process that serves them; by default a fork of this one with a copy of their
                state.
        """
        node = self._nodes[name]
        node.process = process or NodeProcess.fork(self.process_of(name))
        for mate in node.mates:
            mate.process = node.process

    def settle(self) -> None:
        """Wait for pending computations, so that a fault does not depend on the host's speed."""
        for job in self._jobs.values():
            if job.node.process is not None:
                job.settle(self.wall)
        self._jobs.clear()

    def kill(self, name: str, stamp_s: float) -> None:
        """Kill the process of a node as a signal would. Does nothing if the node is down.

        Its present and waiting inputs are lost.

        Args:
            name: Name of a node in a separate process.
            stamp_s: Present stamp, s.
        """
        node = self._nodes[name]
        together = (node, *node.mates)
        jobs = [self._jobs.pop(each.name) for each in together if each.name in self._jobs]
        if not jobs and any(each.busy for each in together):
            return
        for job in jobs:  # the result must not depend on the host's progress
            job.settle(self.wall)
            job.cancelled = True
            self._working -= 1
        node.busy, node.pending = True, None
        self._note_loss(node, stamp_s, NodeLost(hung=False, how="killed by SIGKILL"))
        self._at(stamp_s + self.restart_s, lambda up_s: self._restart(node, up_s))
        self._start_waiting()

    def close(self) -> None:
        """End the processes of all nodes."""
        for node in self._nodes.values():
            if node.process is not None:
                node.process.close(kill=True)
                node.process = None

    def call(
        self, name: str, value: Any, stamp_s: float, *, again: bool = False
    ) -> tuple[Any, float] | None:
        """Run a node at once, outside the queue and without using a core of the platform.

        Args:
            again: Repeat the newest invocation; otherwise the node waits until its end.

        Returns:
            Output, and latency until it takes effect, s; None if the node is busy, down or lost.
        """
        node = self._nodes[name]
        if node.busy or (stamp_s < node.free_s - _SAME_S and not again):
            node.dropped += 1
            return None
        node.invocations += 1
        node.finished += 1
        self.on_start(name, value, stamp_s)
        output: Any = None
        lost: NodeLost | None = None
        try:
            output = _Job(node=node, start_s=stamp_s, input=value).result(self.wall)
        except NodeLost as loss:
            lost = loss
        latency_s = self.draw_latency_s(name)
        self._book(name, stamp_s, latency_s)
        node.free_s = max(node.free_s, stamp_s + latency_s)
        if lost is None:
            return output, latency_s
        node.busy = True
        gone_s = stamp_s + self.watchdog_s if lost.hung else stamp_s
        self._note_loss(node, gone_s, lost)
        self._at(gone_s + self.restart_s, lambda stamp_s: self._restart(node, stamp_s))
        return None

    @property
    def nodes(self) -> dict[str, Node]:
        """All nodes by name, in the order of their addition."""
        return self._nodes

    def submit(self, name: str, value: Any) -> None:
        """Submit an input, which must not be None, to a node at the present simulated time."""
        node = self._nodes[name]
        if node.pending is not None:
            node.dropped += 1
        node.pending = value
        self._start_if_free(node)

    def advance(self, stamp_s: float) -> None:
        """Publish all outputs that are due up to `stamp_s`, in the order of time."""
        while self._events and self._events[0][0] <= stamp_s:
            due_s, _, event = heapq.heappop(self._events)
            self.now_s = max(self.now_s, due_s)
            event(due_s)
        self.now_s = max(self.now_s, stamp_s)

    def compute(self) -> None:
        """Begin the computation of all started invocations. May be called at any time."""
        while self._uncomputed:
            self._uncomputed.pop(0).begin(self.wall)

    def _book(self, name: str, start_s: float, latency_s: float) -> None:
        """Add an invocation to the timetable."""
        self._nodes[name].busy_s += latency_s
        end_s = start_s + latency_s
        self.timetable.append(Invocation(node=name, start_s=start_s, end_s=end_s))

    def _start_if_free(self, node: Node) -> None:
        if node.busy or node.pending is None or any(mate.busy for mate in node.mates):
            return
        if self._working >= self.cores:
            if node not in self._waiting:
                self._waiting.append(node)
            return
        job = _Job(node=node, start_s=self.now_s, input=node.pending)
        node.pending = None
        node.busy = True
        node.invocations += 1
        self.on_start(node.name, job.input, job.start_s)
        if self.compute_first:
            job.begin(self.wall)
        latency_s = self.draw_latency_s(node.name)
        self._book(node.name, job.start_s, latency_s)
        self._working += 1
        self._uncomputed.append(job)
        self._jobs[node.name] = job
        self._at(self.now_s + latency_s, lambda stamp_s: self._finish(job, stamp_s))

    def _at(self, stamp_s: float, event: _Event) -> None:
        heapq.heappush(self._events, (stamp_s, self._count, event))
        self._count += 1

    def _finish(self, job: _Job, end_s: float) -> None:
        if job.cancelled:
            return
        job.node.finished += 1
        self._jobs.pop(job.node.name, None)
        try:
            output = job.result(self.wall)
        except NodeLost as loss:
            self._lose(job, end_s, loss)
            return
        job.node.busy = False
        job.node.publish(output, end_s)  # its core is still busy, so new invocations queue last
        self._start_next(job.node)
        self._working -= 1
        self._start_waiting()

    def _start_next(self, node: Node) -> None:
        """Start the next node of the process that has an input."""
        for each in (*node.mates, node):
            self._start_if_free(each)

    def _start_waiting(self) -> None:
        while self._waiting and self._working < self.cores:
            self._start_if_free(self._waiting.pop(0))

    def _lose(self, job: _Job, end_s: float, loss: NodeLost) -> None:
        """Handle a lost output: the node stays busy until its death, then until its restart."""
        gone_s = max(end_s, job.start_s + self.watchdog_s) if loss.hung else end_s
        job.node.busy_s += gone_s - end_s
        self._note_loss(job.node, gone_s, loss)
        self._at(gone_s, lambda stamp_s: self._end_process(job.node, stamp_s))

    def _note_loss(self, node: Node, gone_s: float, loss: NodeLost) -> None:
        entry = Loss(node=node.name, stamp_s=gone_s, hung=loss.hung, how=loss.how,
                     traceback=loss.traceback)  # fmt: skip
        node.losses.append(entry)
        self.losses.append(entry)
        for mate in node.mates:
            mate.pending = None

    def _end_process(self, node: Node, stamp_s: float) -> None:
        self._working -= 1
        self._at(stamp_s + self.restart_s, lambda up_s: self._restart(node, up_s))
        self._start_waiting()

    def _restart(self, node: Node, _stamp_s: float) -> None:
        """Start a new process with fresh state, as the nodes' copies in this process never ran."""
        if node.process is not None:
            node.process.close(kill=True)
        process = NodeProcess.fork(self.process_of(node.name))
        together = (node, *node.mates)
        for each in together:
            each.process = process
            each.restarts += 1
            each.busy = False
        for each in together:
            each.on_restart(each)
        self._start_next(node)
