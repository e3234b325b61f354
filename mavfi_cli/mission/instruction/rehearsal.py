"""Rehearses a node: replays the requests of a golden flight to it, without the flight.

Before a request the node is stopped and forked, as often as needed. A fork is a copy of the node
just before this invocation, with the same memory. The forks receive the request one after another,
because all share the node's socket. Some are stepped for a profile. One is struck by the fault and
compared with two that are not.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import struct
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from mavfi_cli.attack.kernels.scope import KernelScope
from mavfi_cli.attack.profile import TargetProfile, profile_call, profile_calls, profile_run
from mavfi_cli.attack.served import CHANNEL, ServedProcess
from mavfi_cli.attack.tracer_thread import EntryCounter
from mavfi_cli.companion.node_process import (
    HANG_CPU_S,
    HANG_WALL_S,
    HUNG,
    LostNode,
    NodeLost,
    NodeProcess,
    StruckNodeProcess,
)
from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.processes import value_of
from mavfi_cli.fi.tracer import linux, record
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.fault import InstructionFault
from mavfi_cli.fi.tracer.image import Image, Scope
from mavfi_cli.fi.tracer.inject import reach, strike
from mavfi_cli.fi.tracer.linux import ProcessTimer
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.fi.tracer.sampling import WindowTooLong
from mavfi_cli.fi.tracer.state import StoppedFork, remembers_the_same
from mavfi_cli.fi.tracer.tracee import CLOSE, SENDTO, Tracee
from mavfi_cli.mission.instruction import PROGRAM

Order = tuple[str, Any, float]  # node, input, start stamp
_CREDENTIALS = "3i"  # struct ucred, unix(7): process, user, group
_STEPPED: Any = {
    "limit": 600_000,  # instructions of an invocation, or of one window
    "reads_own_code": False,
}
_WINDOWS, _ENOUGH = 4, 50_000  # for a planner's request with a search: see `profile_run`
_INNER_CALLS = {"octomap": 16}  # sampled calls of one inner function, about 300 instructions each


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelInvocation:
    """One invocation of a kernel, and the entry with which it begins."""

    number: int  # number of the kernel's invocation, from 1
    of: int  # number of invocations to choose from
    order: int  # number of the node's request that contains it, from 1
    entry: int  # number of the kernel's entry with which it begins, from 1
    earlier: int  # entries in the earlier requests


class NodeEffect(Enum):
    """The effect that a fault had on a node by the time of the node's answer."""

    MASKED = "masked"  # answer and memory are as without the fault
    CHANGED = "changed"
    ENDED = "ended"
    HUNG = "hung"


@dataclass(frozen=True, slots=True, kw_only=True)
class Struck:
    """The result of striking a node in a rehearsal.

    Attributes:
        record: fault record, like that of a fault injected in a flight.
        process: process that serves this request and all later ones; None if the fault is masked.
        how: how the node ended or hung; empty if it answers.
    """

    record: FaultRecord
    effect: NodeEffect
    process: NodeProcess | None = None
    how: str = ""


class Rehearsal:
    """A node to which the requests of a golden flight are replayed, and which can be forked.

    It is the `AttackPlace` in which one invocation of the node's kernel runs. Use it in a single
    thread only.

    Args:
        setup: the first message to the node's program.
        node: name of the node.
        orders: requests to the node and to all nodes that share its process, in order of start.
    """

    kind = "node"

    def __init__(self, setup: object, node: str, orders: Sequence[Order]) -> None:
        self._node, self._orders = node, orders
        self._done, self._entry = 0, 1  # finished requests; awaited entry in the next one
        self._stopped: Tracee | None = None  # the node, stopped before a request
        self._sender = threading.Thread()
        self._sender.start()
        self._spawned = ServedProcess.of(PROGRAM)
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            self.scope_of_node: KernelScope = self._spawned.begin(setup, f"node {node}")
            self._process = NodeProcess(self._spawned.connection, self._spawned.pid)
            self._image = Image(self._spawned.pid, self.scope_of_node.regions)
            undo.pop_all()

    def close(self) -> None:
        """End the node's process."""
        self._spawned.kill()

    @property
    def name(self) -> str:
        """Name of the node's kernel."""
        return self.scope_of_node.kernel

    # Orders

    def count_entries(self) -> list[int]:
        """Return the cumulative number of kernel entries at the end of each request to the node.

        A fork of the node processes the requests.

        Raises:
            TracingForbidden: the operating system permits neither counting nor tracing.
        """
        counts, address = [], self._image.address(self.scope_of_node.entry)
        fork = self._stop().fork()
        fork.detach()
        process = NodeProcess(self._spawned.connection, fork.pid)
        try:
            with contextlib.closing(EntryCounter(fork.pid, address)) as counter:
                for node, value, start_s in self._orders:
                    if node == self._node:
                        process.take(process.order(node, value, start_s))
                        counts.append(counter.read())
        finally:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(fork.pid, signal.SIGKILL)
                os.waitpid(fork.pid, 0)
        return counts

    def go_to(self, invocation: KernelInvocation) -> None:
        """Let the node process all requests that precede the one with the given invocation.

        The invocation must not precede that of an earlier call. The node and its forks stay on one
        processor, because switching between two doubles the time of stepping, and the C library
        keeps the processor's number in the memory of each thread.
        """
        linux.share_processor(self._spawned.pid)
        self._entry = invocation.entry - invocation.earlier
        own = [at for at, (node, *_) in enumerate(self._orders) if node == self._node]
        self._sender.join()
        while self._done < own[invocation.order - 1]:
            if self._stopped is not None:
                self._stopped.detach()
                self._stopped = None
            self._process.take(self._process.order(*self._orders[self._done]))
            self._done += 1

    def _stop(self) -> Tracee:
        """Stop the node in the system call in which it waits for the next request."""
        if self._stopped is None:
            self._stopped = Tracee.attach(self._spawned.pid, alone=True)
            self._stopped.await_call()
        return self._stopped

    def _fork(self) -> Tracee:
        """Fork the stopped node, and send the next request to the fork."""
        self._sender.join()
        fork, order = self._stop().fork(), self._orders[self._done]
        # Sending a long message blocks until the fork, which runs later, reads it.
        self._sender = threading.Thread(target=self._process.rehearse, args=order, daemon=True)
        self._sender.start()
        return fork

    # Profile

    def start(self) -> Tracee:
        """Return a fork of the node, stopped at the start of the invocation.

        The fork cannot send an answer, so it ends after the invocation.
        """
        tracee = self._fork()
        if not tracee.run_to(self._image.address(self.scope_of_node.entry), self._entry):
            raise TargetError(f"node {self._node}", "a fork did not begin the invocation again")
        tracee.system_call(CLOSE, CHANNEL)
        return tracee

    def image(self, _: Tracee) -> Image:
        """Return the memory image, which is the same for the node and all of its forks."""
        return self._image

    def scope(self, image: Image) -> Scope:
        """Return the code that faults may hit."""
        return image.scope(self.scope_of_node.objects)

    def profile(self, invocation: KernelInvocation, rng: np.random.Generator) -> TargetProfile:
        """Profile an invocation by single-stepping all of its instructions, or a sample of them.

        Args:
            rng: draws the sample, if only a sample is stepped.

        Raises:
            TracingForbidden: the operating system does not permit tracing.
            WindowTooLong: the invocation is too long to be stepped.
            TargetError: nothing in scope executes.
        """
        self.go_to(invocation)
        return self._stepped(rng).after(CountedStop(self.scope_of_node.entry, invocation.entry))

    def _stepped(self, rng: np.random.Generator) -> TargetProfile:
        node, inner = self._node, self.scope_of_node.inner
        if node in _INNER_CALLS:
            return profile_calls(self, rng, inner, windows=_INNER_CALLS[node], **_STEPPED)
        if node != "planner":
            return profile_call(self, **_STEPPED)
        # No native function encloses a request: Python calls several compiled functions, and only
        # some requests need a search, which begins with the first of `inner`. So the request ends
        # with the run. It is stepped whole if it needs no search.
        tracee = self.start()
        try:
            searches = tracee.run_to(self._image.address(inner[0]))
        finally:
            tracee.kill()
        if not searches:
            with contextlib.suppress(WindowTooLong):  # smoothing may repeat its passes
                return profile_run(self, rng, **_STEPPED)
        several: Any = {"markers": inner, "windows": _WINDOWS, "enough": _ENOUGH}
        return profile_run(self, rng, **several, **_STEPPED)

    # Strike

    def strike(
        self, fault: InstructionFault, invocation: KernelInvocation, context: Mapping[str, Any]
    ) -> Struck:
        """Strike an invocation in a fork, and compare the fork with two forks without the fault.

        If the struck fork differs from them, it is kept, so that a flight can continue with it.

        Args:
            context: further entries of the record.

        Raises:
            TracingForbidden: the operating system does not permit tracing.
            OSError: no fork can be made, or its memory cannot be read.
            FaultError: another instruction is at the fault's location.
            TargetError: the fork does not reach the fault's location, hangs before the fault
                strikes, or cannot be compared.
        """
        self.go_to(invocation)
        objects = list(self.scope_of_node.objects)
        planned = record.planned(fault, self._image, scope=objects, **context)
        first, *others = fault.trigger
        here = replace(fault, trigger=(replace(first, count=self._entry), *others))
        with contextlib.ExitStack() as unneeded, contextlib.ExitStack() as undo:

            def reached(undo: contextlib.ExitStack) -> tuple[Tracee, str]:
                tracee = self._fork()
                undo.callback(tracee.kill)
                return tracee, reach(tracee, self._image, here)

            tracee, reason = reached(undo)
            if reason:
                raise TargetError(f"node {self._node}", reason)
            with _limited(tracee) as alarm:
                injection, followed = strike(tracee, here, window=64)
            if alarm.fired:
                raise TargetError(f"node {self._node}", "it hung before the fault struck")
            reason = "" if injection is None else injection.reason
            done = record.completed(planned, injection, followed, not_injected_reason=reason)
            struck = _run_to_answer(tracee)
            if not isinstance(struck, StoppedFork):
                effect = NodeEffect.HUNG if struck.hung else NodeEffect.ENDED
                lost = LostNode(struck)
                return Struck(record=done, effect=effect, process=lost, how=str(struck))
            runs = (_run_to_answer(reached(unneeded)[0]) for _ in range(2))
            unstruck = [fork for fork in runs if isinstance(fork, StoppedFork)]
            if len(unstruck) < 2:
                raise TargetError(
                    f"node {self._node}",
                    "it gave no answer when the same invocation was repeated without the fault",
                )
            if remembers_the_same(struck, unstruck):
                return Struck(record=done, effect=NodeEffect.MASKED)
            process = self._let_go(tracee)
            undo.pop_all()
            return Struck(record=done, effect=NodeEffect.CHANGED, process=process)

    def _let_go(self, fork: Tracee) -> NodeProcess:
        """Give a connection of its own to a fork that is about to answer, and let it continue."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            listener.bind("")  # an address that the operating system chooses
            listener.listen()
            fork.step_back()
            fork.connect(CHANNEL, listener.getsockname())
            connection, _ = listener.accept()
            while _process_at(connection) != fork.pid:  # any process can connect
                connection.close()
                connection, _ = listener.accept()
        os.sched_setaffinity(fork.pid, os.sched_getaffinity(os.getpid()))
        fork.detach()
        return StruckNodeProcess(connection, fork.pid, number=self._process.next_number)


def _run_to_answer(tracee: Tracee) -> StoppedFork | NodeLost:
    """Run a fork until it begins to send its answer, or return the loss if it ends or hangs."""
    calls: Sequence[tuple[int, ...]] = ()
    if tracee.ended is None:
        with _limited(tracee) as alarm:
            calls = tracee.run_to_call(SENDTO, CHANNEL)
        if alarm.fired:
            return NodeLost(hung=True, how=HUNG)
    if (ended := tracee.ended) is not None:
        return NodeLost(hung=False, how=ended.describe())
    _, _, address, size, *_ = calls[-1]
    return StoppedFork(tracee=tracee, calls=calls, clock=_time_of(tracee.memory, address, size))


def _process_at(connection: socket.socket) -> int:
    """Return the id of the process at the other end of a Unix socket."""
    size = struct.calcsize(_CREDENTIALS)
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    return int(struct.unpack(_CREDENTIALS, credentials)[0])


def _limited(tracee: Tracee) -> ProcessTimer:
    """Return a timer that kills the node if it hangs."""
    return ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=HANG_CPU_S, wall_s=HANG_WALL_S)


def _time_of(memory: linux.Memory, address: int, size: int) -> bytes:
    """Return the packed host time in a node's answer, or b"" if the answer is corrupted.

    Args:
        address, size: Place and length of the answer in the memory.
    """
    try:
        return struct.pack(">d", value_of(memory.read(address, size)).host_s)
    except Exception:  # a corrupted pickle can raise any error
        return b""
