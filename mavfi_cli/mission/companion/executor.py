"""Nodes that work side by side in simulated time, as ROS nodes do.

A node runs one kernel. It has a queue of one: a newer input replaces a waiting older one. An
invocation that starts at `t` occupies the node, and one core of the platform, until `t` plus
its latency; only then is its output published. The real computation is done at any host time
in between, so the vehicle's simulation need not wait for it.

Nodes that share a process work one after the other, each with its newest input, in the order in
which they are listed. They end together, and what waits for any of them is lost.

A node in a process of its own may die, of a signal or of an error in its kernel. The input that it
worked on is lost, and it starts anew, with fresh state, a restart time after its output was due. A
node that hangs works on until the watchdog kills it. Both are decided by *what* became of the
process, never by when the host noticed, so they repeat.
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
    """One end of a node's process."""

    node: str
    stamp_s: float  # when the output was due, or the watchdog acted
    hung: bool
    how: str
    traceback: str = ""  # of an error in the kernel


@dataclass(slots=True, eq=False)
class Node:
    """One node: a kernel, what to do with its output, and its queue of one."""

    name: str
    run: Run
    publish: Publish
    on_restart: Callable[[Node], None]
    pending: Any = None
    busy: bool = False
    invocations: int = 0
    dropped: int = 0  # inputs that a newer one replaced before they were looked at
    busy_s: float = 0.0
    process: NodeProcess | None = None  # where the real work is done; None: here
    losses: list[Loss] = field(default_factory=list)
    restarts: int = 0
    finished: int = 0  # invocations that are over, well or not
    free_s: float = 0.0  # end of the newest work outside the queue
    mates: list[Node] = field(default_factory=list)  # in its process: those after it, then before


@dataclass(slots=True, eq=False)
class _Job:
    """One invocation between its start and the moment its output takes effect."""

    node: Node
    start_s: float
    input: Any
    order: int | None = None  # number of the order in the node's process
    done: bool = False
    cancelled: bool = False  # its process was killed before the output was due
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

    def settle(self, wall: WallClock) -> None:
        """Wait for the work that a process was given, whatever comes of it."""
        if self.order is not None and not self.done:
            with contextlib.suppress(NodeLost):
                self.result(wall)

    def result(self, wall: WallClock) -> Any:
        """The output, waiting for it where it is not there yet."""
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
        compute_first: an invocation's latency is asked for after its real work is done.
        restart_s: from a node's end until its successor is ready, simulated.
        watchdog_s: an invocation that has not ended after so long is killed, simulated.
        losses: of all nodes, in order.
        timetable: every invocation, in the order in which they started.
        on_start: hears of every invocation: node, input, start stamp.
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
    _jobs: dict[str, _Job] = field(default_factory=dict)  # whose output is not due yet
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
            name: selects its latency.
            run: the kernel.
            publish: takes its output, when it is due.
            on_restart: hears that it is up again after its end, before it takes its next input.
        """
        node = Node(name=name, run=run, publish=publish, on_restart=on_restart)
        self._nodes[name] = node
        return node

    def share_process(self, names: Sequence[str]) -> None:
        """Let nodes share a process, as one thread in it: the order is that of its loop."""
        nodes = [self._nodes[name] for name in names]
        for place, node in enumerate(nodes):
            node.mates = nodes[place + 1 :] + nodes[:place]

    def process_of(self, name: str) -> dict[str, Run]:
        """What the process of a node runs: its kernel and those of its mates, by name."""
        node = self._nodes[name]
        return {each.name: each.run for each in (node, *node.mates)}

    def isolate(self, name: str, process: NodeProcess | None = None) -> None:
        """Let a node do its real work in a process apart from now on; `close` ends it.

        Args:
            name: of the node; its mates move with it.
            process: one that serves them; default a fork of this one, to which their state moves.
        """
        node = self._nodes[name]
        node.process = process or NodeProcess.fork(self.process_of(name))
        for mate in node.mates:
            mate.process = node.process

    def settle(self) -> None:
        """Wait for work under way: what a fault does there must not depend on the host's pace."""
        for job in self._jobs.values():
            if job.node.process is not None:
                job.settle(self.wall)
        self._jobs.clear()

    def kill(self, name: str, stamp_s: float) -> None:
        """End the process of a node as a signal would; nothing is left to kill where it is down.

        What it works on is lost, and so is what waits for it.

        Args:
            name: of a node that works in a process apart.
            stamp_s: now.
        """
        node = self._nodes[name]
        together = (node, *node.mates)
        jobs = [self._jobs.pop(each.name) for each in together if each.name in self._jobs]
        if not jobs and any(each.busy for each in together):
            return
        for job in jobs:  # how far it came on this host must not matter
            job.settle(self.wall)
            job.cancelled = True
            self._working -= 1
        node.busy, node.pending = True, None
        self._note_loss(node, stamp_s, NodeLost(hung=False, how="killed by SIGKILL"))
        self._at(stamp_s + self.restart_s, lambda up_s: self._revive(node, up_s))
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
        """Have a node work at once, outside the queue and on no core of the platform's.

        Args:
            again: its newest work anew; else it takes nothing before the end of that.

        Returns:
            Its output, and the latency after which that takes effect, s; None while the node is
            still at work or down, or if it is lost.
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
        self._at(gone_s + self.restart_s, lambda stamp_s: self._revive(node, stamp_s))
        return None

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

    def advance(self, stamp_s: float) -> None:
        """Publish every output that takes effect up to `stamp_s`, in the order of time."""
        while self._events and self._events[0][0] <= stamp_s:
            due_s, _, event = heapq.heappop(self._events)
            self.now_s = max(self.now_s, due_s)
            event(due_s)
        self.now_s = max(self.now_s, stamp_s)

    def compute(self) -> None:
        """Begin the real work of every invocation that has started; safe to call at any time."""
        while self._uncomputed:
            self._uncomputed.pop(0).begin(self.wall)

    def _book(self, name: str, start_s: float, latency_s: float) -> None:
        """Put an invocation into the time table."""
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
        job.node.publish(output, end_s)  # its core is still taken: what this starts asks last
        self._start_next(job.node)
        self._working -= 1
        self._start_waiting()

    def _start_next(self, node: Node) -> None:
        """A node is free: the next of its process that has an input works."""
        for each in (*node.mates, node):
            self._start_if_free(each)

    def _start_waiting(self) -> None:
        while self._waiting and self._working < self.cores:
            self._start_if_free(self._waiting.pop(0))

    def _lose(self, job: _Job, end_s: float, loss: NodeLost) -> None:
        """The output will never come: the node stays busy until it is dead, then until it is up."""
        gone_s = max(end_s, job.start_s + self.watchdog_s) if loss.hung else end_s
        job.node.busy_s += gone_s - end_s
        self._note_loss(job.node, gone_s, loss)
        self._at(gone_s, lambda stamp_s: self._bury(job.node, stamp_s))

    def _note_loss(self, node: Node, gone_s: float, loss: NodeLost) -> None:
        entry = Loss(node=node.name, stamp_s=gone_s, hung=loss.hung, how=loss.how,
                     traceback=loss.traceback)  # fmt: skip
        node.losses.append(entry)
        self.losses.append(entry)
        for mate in node.mates:
            mate.pending = None

    def _bury(self, node: Node, stamp_s: float) -> None:
        self._working -= 1
        self._at(stamp_s + self.restart_s, lambda up_s: self._revive(node, up_s))
        self._start_waiting()

    def _revive(self, node: Node, _stamp_s: float) -> None:
        """A new process with fresh state: this one's copy of the nodes has never worked."""
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
