"""Nodes that work side by side in simulated time, as ROS nodes do.

A node runs one kernel. It has a queue of one: a newer input replaces a waiting older one. An
invocation that starts at `t` occupies the node, and one core of the platform, until `t` plus
its latency; only then is its output published. The real computation is done at any host time
in between, so the vehicle's simulation need not wait for it.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mavfi_cli.core.wall import WallClock
from mavfi_cli.mission.node_process import NodeProcess

Run = Callable[[Any, float], Any]  # (input, start stamp) -> output
Publish = Callable[[Any, float], None]  # (output, stamp at which it takes effect)


@dataclass(slots=True, eq=False)
class Node:
    """One node: a kernel, what to do with its output, and its queue of one."""

    name: str
    run: Run
    publish: Publish
    pending: Any = None
    busy: bool = False
    invocations: int = 0
    dropped: int = 0  # inputs that a newer one replaced before they were looked at
    busy_s: float = 0.0
    process: NodeProcess | None = None  # where the real work is done; None: here


@dataclass(slots=True, eq=False)
class _Job:
    """One invocation between its start and the moment its output takes effect."""

    node: Node
    start_s: float
    input: Any
    order: int | None = None  # number of the order in the node's process
    done: bool = False
    output: Any = None

    def begin(self, wall: WallClock) -> None:
        """Do the real work, or have the node's process do it."""
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

    def result(self, wall: WallClock) -> Any:
        """The output, waiting for it where it is not there yet."""
        self.begin(wall)
        if not self.done:
            assert self.node.process is not None
            assert self.order is not None
            self.output, host_s = self.node.process.take(self.node.name, self.order)
            wall.add(self.node.name, host_s)
            self.done = True
        return self.output


@dataclass(frozen=True, slots=True, kw_only=True)
class Invocation:
    """A line of the time table: which node worked from when to when."""

    node: str
    start_s: float
    end_s: float


@dataclass(slots=True)
class Executor:
    """Runs nodes in simulated time on a number of cores.

    Attributes:
        draw_latency_s: latency of the next invocation of a node, by its name.
        cores: how many nodes can work at the same time; the rest wait in the order of asking.
    """

    draw_latency_s: Callable[[str], float]
    cores: int
    wall: WallClock = field(default_factory=WallClock)
    now_s: float = 0.0
    timetable: list[Invocation] = field(default_factory=list)
    _nodes: dict[str, Node] = field(default_factory=dict)
    _events: list[tuple[float, int, _Job]] = field(default_factory=list)  # heap by time, then order
    _waiting: list[Node] = field(default_factory=list)
    _uncomputed: list[_Job] = field(default_factory=list)
    _working: int = 0
    _count: int = 0

    def add(self, name: str, run: Run, publish: Publish) -> Node:
        """Add a node; its name selects its latency."""
        node = Node(name=name, run=run, publish=publish)
        self._nodes[name] = node
        return node

    def fork(self, names: Sequence[str]) -> NodeProcess:
        """Let these nodes do their real work in one process of their own, from now on.

        Their state moves there; the caller closes the process.
        """
        process = NodeProcess({name: self._nodes[name].run for name in names})
        for name in names:
            self._nodes[name].process = process
        return process

    @property
    def nodes(self) -> dict[str, Node]:
        """All nodes by name, in the order in which they were added."""
        return self._nodes

    def submit(self, name: str, value: Any) -> None:
        """Give a node its newest input at the present simulated time; `value` is not None."""
        node = self._nodes[name]
        if node.pending is not None:
            node.dropped += 1
        node.pending = value
        self._start_if_free(node)

    def idle(self, name: str) -> bool:
        """Whether a node neither works nor has an input waiting."""
        node = self._nodes[name]
        return not node.busy and node.pending is None

    def cancel_pending(self, name: str) -> None:
        """Forget the input that a node has not looked at yet."""
        self._nodes[name].pending = None

    def advance(self, stamp_s: float) -> None:
        """Publish every output that takes effect up to `stamp_s`, in the order of time."""
        while self._events and self._events[0][0] <= stamp_s:
            end_s, _, job = heapq.heappop(self._events)
            self.now_s = max(self.now_s, end_s)
            self._finish(job, end_s)
        self.now_s = max(self.now_s, stamp_s)

    def compute(self) -> None:
        """Begin the real work of every invocation that has started; safe to call at any time."""
        while self._uncomputed:
            self._uncomputed.pop(0).begin(self.wall)

    def _start_if_free(self, node: Node) -> None:
        if node.busy or node.pending is None:
            return
        if self._working >= self.cores:
            if node not in self._waiting:
                self._waiting.append(node)
            return
        latency_s = self.draw_latency_s(node.name)
        job = _Job(node=node, start_s=self.now_s, input=node.pending)
        node.pending = None
        node.busy = True
        node.invocations += 1
        node.busy_s += latency_s
        self._working += 1
        self._uncomputed.append(job)
        end_s = self.now_s + latency_s
        self.timetable.append(Invocation(node=node.name, start_s=self.now_s, end_s=end_s))
        heapq.heappush(self._events, (end_s, self._count, job))
        self._count += 1

    def _finish(self, job: _Job, end_s: float) -> None:
        output = job.result(self.wall)
        job.node.busy = False
        self._working -= 1
        job.node.publish(output, end_s)
        self._start_if_free(job.node)
        while self._waiting and self._working < self.cores:
            self._start_if_free(self._waiting.pop(0))
