"""Plans one exact instruction-level fault of a mission, and injects it beside the flight.

A tracer thread injects it. The orders that the golden run gave to each node, the number of entries
of each kernel, and each profile are kept below the output folder, under a hash of everything that
they depend on.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mavfi_cli.attack.attacker import LiveAttack, TracerThread, attack_live
from mavfi_cli.attack.kernels.scope import KernelScope, kernel_of_node
from mavfi_cli.attack.served import ServedProcess, served_process
from mavfi_cli.attack.target import TargetProfile
from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.injection import SCHEMA, NoInjection
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.core.errors import FaultError, RecordError
from mavfi_cli.core.files import own_digest, write_atomically, writing
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.types import Briefing
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.fault import InstructionFault
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.mission.instruction import PROGRAM
from mavfi_cli.mission.instruction.rehearsal import Order, count_entries, profile_invocation
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.progress import Recorder
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

T = TypeVar("T")
CACHE = ".profiles"


@dataclass(frozen=True, slots=True, kw_only=True)
class _PlannedFault:
    """One exact instruction-level fault of a mission."""

    fault: InstructionFault
    context: Mapping[str, Any]  # further entries of the record, by the names of _CONTEXT
    recorded: Mapping[str, Any] | None = None  # the repeated record; None for a drawn fault


def _plan_fault(
    config: MissionConfig,
    asked: InstructionConfig,
    out: Path,
    versions: Mapping[str, str],
    fly_golden: Callable[[MissionConfig, Path, Recorder], object],
) -> _PlannedFault:
    """Draw the fault of a mission and a seed; arguments as for `injection_of`."""
    strategy, node = asked.strategy(), asked.node()
    kernel = kernel_of_node(node, config.planner)
    golden = config.golden
    folder = out / CACHE / _key(golden, versions)

    def fly() -> tuple[Briefing, dict[str, list[Order]]]:
        """The briefing of the golden run, and the orders that it gave, by node."""
        recorder = Recorder()
        fly_golden(golden, folder, recorder)
        assert recorder.briefing is not None
        return recorder.briefing, recorder.orders

    briefing, all_orders = _kept(folder / "orders.pickle", fly)
    setup = Setup.of(config, briefing, node)
    orders = all_orders.get(node, [])
    counts = _kept(folder / f"entries-{kernel}.pickle", lambda: count_entries(setup, orders))
    if not counts or not counts[-1]:
        raise FaultError(
            f"the golden flight never enters {kernel}, so nothing in it can be hit: choose another "
            "world, seed or node"
        )
    rng = generator(asked.seed, Stream.FAULT, "instruction")
    drawn = draw_invocation(node, counts, rng)
    profiling = generator(config.seed, Stream.FAULT, "profile", kernel, drawn.number)
    found: TargetProfile = _kept(
        folder / f"profile-{kernel}-{drawn.number}.pickle",
        lambda: profile_invocation(
            setup, orders[: drawn.order], drawn.entry, drawn.earlier, profiling
        ),
    )
    fault = found.draw(replace(strategy, whole_process=False), rng)
    context = {
        "node": node,
        "kernel": kernel,
        "invocation": drawn.number,
        "invocations": drawn.of,
        "node_invocation": drawn.order,
        "stamp_s": round(orders[drawn.order - 1][1], 9),
        "sampling": asked.sampling_name(),
        "windows": found.windows,
        "profiled_instructions": found.executed,
        "seed": asked.seed,
        "request": asdict(asked),
    }
    struck = replace(fault, corruption=None) if asked.null else fault
    return _PlannedFault(fault=struck, context=context)


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelInvocation:
    """One invocation of a kernel, and the entry with which it begins."""

    number: int  # number of the kernel's invocation, from 1
    of: int
    order: int  # number of the node's order that contains it, from 1
    entry: int  # number of the kernel's entry with which it begins, from 1
    earlier: int  # entries in the earlier orders


def draw_invocation(
    node: str, counts: Sequence[int], rng: np.random.Generator
) -> _KernelInvocation:
    """Draw one invocation of a kernel uniformly from the entries up to each order.

    Each entry is an invocation, except for a planner node. It is entered each time it builds an
    obstacle grid, once or more in a request, and the request is the invocation.

    Args:
        counts: entries up to each order of the golden run, ascending; not empty.
    """
    before = np.array([0, *counts[:-1]])
    if node != "planner":
        number = entry = int(rng.integers(counts[-1])) + 1
        order, of = int(np.searchsorted(counts, entry)), counts[-1]
    else:
        orders = np.flatnonzero(np.array(counts) > before)
        which, of = int(rng.integers(len(orders))), len(orders)
        order, number = int(orders[which]), which + 1
        entry = int(before[order]) + 1
    return _KernelInvocation(
        number=number, of=of, order=order + 1, entry=entry, earlier=int(before[order])
    )


def _planned_of(recorded: Mapping[str, Any]) -> _PlannedFault:
    """Read the fault of a record, to repeat it."""
    fault = record.fault_of(recorded)
    try:
        context = {name: recorded[name] for name in _CONTEXT}
    except KeyError as error:
        raise RecordError(f"the fault record is damaged: it has no {error}") from None
    return _PlannedFault(fault=fault, context=context, recorded=recorded)


_CONTEXT = (
    "node", "kernel", "invocation", "invocations", "node_invocation", "stamp_s", "sampling",
    "windows", "profiled_instructions", "seed", "request",
)  # fmt: skip


def _kept(path: Path, make: Callable[[], T]) -> T:
    """Read a value from its file, or make it and keep it there."""
    if path.is_file():
        kept: T = pickle.loads(path.read_bytes())
        return kept
    value = make()
    with writing(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: pickle.dump(value, file))
    return value


def _key(golden: MissionConfig, versions: Mapping[str, str]) -> str:
    """A hash of everything that the golden run depends on."""
    values = golden.to_dict()
    files = [Path(name) for name in golden.files]
    parts = [
        json.dumps(values, sort_keys=True),
        json.dumps(dict(versions), sort_keys=True),
        own_digest(),
        *(hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()),
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


class _InstructionInjection(NoInjection):
    """One instruction-level fault in one mission; messages pass unchanged.

    Args:
        for_debugger: called when the node waits for a debugger at the injected instruction.
    """

    def __init__(
        self,
        planned: _PlannedFault,
        spawned: ServedProcess,
        for_debugger: Callable[[int], None] | None = None,
    ) -> None:
        super().__init__()
        self._planned = planned
        self._spawned = spawned
        self._for_debugger = for_debugger
        self._path: Path | None = None
        self._tracer: TracerThread[LiveAttack] | None = None
        self._reached = threading.Event()  # the trigger, or the end of the attack without it
        self._struck = False  # in an invocation whose answer is there
        self._told = False
        self.node = str(planned.context["node"])

    def begin(self, path: Path) -> None:
        self._path = path

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Move the attacked node into its own process and arm the fault there.

        Raises:
            BuildMismatch: the repeated record is of another build.
            TracingForbidden: the operating system refuses.
        """
        scope = self._spawned.begin(Setup.of(config, briefing, self.node), f"node {self.node}")
        pid = self._spawned.pid
        if self._planned.recorded is not None:
            record.require_same_build(self._planned.recorded, Image(pid, scope.regions))
        self._tracer = TracerThread(lambda armed: self._attack(pid, scope, armed))
        self._tracer.await_armed()
        process = NodeProcess(
            self._spawned.connection,
            pid,
            ending=self._ending,
            answered=self._note_strike,
            patient=self._for_debugger is not None,
        )
        executor.isolate(self.node, process)

    def _attack(self, pid: int, scope: KernelScope, armed: Callable[[], None]) -> LiveAttack:
        assert self._path is not None
        debugging = self._for_debugger is not None
        try:
            done = attack_live(
                pid,
                self._planned.fault,
                path=self._path,
                regions=scope.regions,
                window=0 if debugging else 64,
                armed=armed,
                reached=self._reached.set,
                leave_stopped=debugging,
                scope=list(scope.objects),
                **self._planned.context,
            )
        finally:
            self._reached.set()
        if self._for_debugger is not None and done.ended is None:
            self._for_debugger(pid)
        return done

    def _ending(self) -> str | None:
        """How the node ended, if the tracer was told."""
        if self._tracer is None:
            return None
        ended = self._tracer.result().ended
        if ended is None:
            return None
        if ended.signal is not None:
            return f"killed by {signal.Signals(ended.signal).name}"
        return f"ended with code {ended.exit_code}"

    def _note_strike(self) -> None:
        """Ask between two inputs of the node: the tick of the news must not depend on speed.

        A detector may have changed the flight before the fault. Then the trigger comes in another
        invocation than planned, or never.
        """
        self._struck = self._struck or self._reached.is_set()

    def news(self) -> list[str]:
        """The fault as text, once the struck invocation is over."""
        if self._told or self._tracer is None or not self._struck:
            return []
        self._told = True
        done = self._tracer.result()
        if self._planned.fault.corruption is None:
            return []
        return [_attack_text(done.record)]

    def finish(self) -> dict[str, Any] | None:
        """The record at the end of the mission, without measured times."""
        if self._tracer is None:
            self._spawned.kill()
            return None
        return _in_result(self._tracer.result().record)

    def close(self) -> None:
        """End the node's process if no executor owns it."""
        if self._tracer is None:
            self._spawned.kill()


def _in_result(written: Mapping[str, Any]) -> dict[str, Any]:
    """A fault record as result.json carries it: the same in every repetition."""
    injection = {k: v for k, v in written["injection"].items() if k != "stop_s"}
    state = "applied" if injection["applied"] else "not_injected"
    if written["corruption"] is None and not written.get("not_injected_reason"):
        state = "null"
    reason = written.get("not_injected_reason", "")
    return {**written, "schema": SCHEMA, "state": state, "reason": reason, "injection": injection}


def _attack_text(written: Mapping[str, Any]) -> str:
    place = written["symbol"] or f"{written['object']}+{written['offset']:#x}"
    where = f"{written['kernel']}, {written['instruction']} at {place}"
    if not written["injection"]["applied"]:
        return f"fault in {where}: not injected ({written.get('not_injected_reason', '')})"
    corruption = written["corruption"]
    bits = ", ".join(map(str, corruption["bits"]))
    what = corruption["register"] or corruption["site"]
    activation = written["activation"]["activation"].replace("_", " ")
    return f"fault in {where}: bit {bits} of {corruption['role']} {what}, {activation}"


def injection_of(
    config: MissionConfig,
    out: Path,
    versions: Mapping[str, str],
    fly_golden: Callable[[MissionConfig, Path, Recorder], object],
    *,
    repeat: Mapping[str, Any] | None = None,
    for_debugger: Callable[[int], None] | None = None,
) -> _InstructionInjection:
    """Plan the instruction-level fault of a mission, and start its node's process.

    Args:
        out: the folder below which golden runs and profiles are kept.
        fly_golden: function that flies a mission into a folder and records it.
        repeat: the record of a fault to repeat; None draws one.
        for_debugger: called when the node waits for a debugger at the injected instruction.

    Raises:
        FaultError: the flight is not repeatable, or nothing can be hit in it.
    """
    assert config.instruction is not None
    if config.link is not None:
        raise FaultError(
            "an instruction-level fault needs flights that repeat, and those of a foreign "
            "autopilot do not: leave out --link"
        )
    if repeat is not None:
        planned = _planned_of(repeat)
    else:
        planned = _plan_fault(config, config.instruction, out, versions, fly_golden)
    return _InstructionInjection(planned, served_process(PROGRAM), for_debugger)
