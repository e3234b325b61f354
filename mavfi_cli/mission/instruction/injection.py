"""Plans one exact instruction-level fault of a mission, and injects it during the flight.

What a node does depends only on its requests. A rehearsal sends the requests of the golden run to a
separate node, without a flight and as fast as the machine allows. Requests, numbers of kernel
entries and profiles are kept in a subfolder of the output folder, named by a hash of everything
that determines them. In the flight a tracer thread injects the fault.

Nodes of missions that share a flight are struck in the rehearsal. A fault that changes neither the
node's answer nor its memory needs no flight. Otherwise the flight takes over the struck node.
"""

from __future__ import annotations

import contextlib
import pickle
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mavfi_cli.attack.kernels.scope import KernelScope, kernel_of_node
from mavfi_cli.attack.live import LiveAttack, attack_live, mission_strategy
from mavfi_cli.attack.profile import TargetProfile
from mavfi_cli.attack.served import ServedProcess
from mavfi_cli.attack.tracer_thread import TracerThread
from mavfi_cli.autonomy.collision import CollisionInputs
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.injection import NoInjection, StruckNode
from mavfi_cli.companion.kernels import ControlInput
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.core.archive import pack, unpack
from mavfi_cli.core.config import structure_record
from mavfi_cli.core.errors import FaultError, MavfiError, RecordError
from mavfi_cli.core.files import (
    own_folder,
    read_bounded,
    write_atomically,
)
from mavfi_cli.core.flight_record import MissionInstructionFault
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import KERNELS, Briefing, DepthFrame, PointCloud
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.fault import InstructionFault
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.mission.instruction import PROGRAM, kept_in
from mavfi_cli.mission.instruction.rehearsal import (
    KernelInvocation,
    Order,
    Rehearsal,
    Struck,
)
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.progress import Recorder
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

T = TypeVar("T")
_Given = tuple[T, float]  # input, start stamp
FlyGolden = Callable[[MissionConfig, Path, Recorder], object]  # mission, folder of runs, recorder
_CONTEXT = (
    "node", "kernel", "invocation", "invocations", "node_invocation", "stamp_s", "sampling",
    "windows", "profiled_instructions", "seed", "request",
)  # fmt: skip


_LARGEST = 1 << 31  # bytes of a kept file


@dataclass(frozen=True, slots=True, kw_only=True)
class GoldenOrders:
    """The briefing of a golden run, and the requests that each of its nodes received.

    Attributes:
        sequence: node of every request, in order of start.
    """

    briefing: Briefing
    sequence: tuple[str, ...] = ()
    point_cloud: tuple[_Given[DepthFrame], ...] = ()
    octomap: tuple[_Given[PointCloud], ...] = ()
    collision_check: tuple[_Given[CollisionInputs], ...] = ()
    planner: tuple[_Given[tuple[PlanRequest, MapSnapshot]], ...] = ()
    control: tuple[_Given[ControlInput], ...] = ()

    @classmethod
    def of(cls, recorder: Recorder) -> GoldenOrders:
        """Return the briefing and the requests that a recorder has captured in a flight."""
        assert recorder.briefing is not None
        orders = {name: tuple(given) for name, given in recorder.orders.items()}
        return cls(briefing=recorder.briefing, sequence=tuple(recorder.sequence), **orders)

    def __post_init__(self) -> None:
        if any(len(getattr(self, name)) != self.sequence.count(name) for name in KERNELS):
            raise ValueError("sequence must name the node of every request")

    def of_process(self, nodes: Sequence[str]) -> list[Order]:
        """Return the requests to all nodes of one process, in order of start."""
        left = {node: iter(getattr(self, node)) for node in nodes}
        return [(node, *next(left[node])) for node in self.sequence if node in left]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Entries:
    """The cumulative number of a kernel's entries at the end of every request to its node."""

    counts: tuple[int, ...]

    def __post_init__(self) -> None:
        if any(later < earlier for earlier, later in pairwise((0, *self.counts))):
            raise ValueError("counts must not decrease")


def _golden_orders(
    golden: MissionConfig, profiles: Path, fly: Callable[[Path], Recorder]
) -> GoldenOrders:
    """Return the stored requests of a golden mission. If none are stored, call `fly` for them.

    `fly` receives a folder for the flight. The requests that it records are stored.
    """
    folder = own_folder(kept_in(own_folder(profiles), golden))
    return _kept(folder / "orders.npz", GoldenOrders, lambda: GoldenOrders.of(fly(folder)))


def keep_orders(golden: MissionConfig, profiles: Path, fly_golden: FlyGolden) -> GoldenOrders:
    """Return the stored requests of a golden mission. If none are stored, fly it and store them.

    Args:
        profiles: folder that keeps golden flights and profiles.
        fly_golden: flies the golden mission if no requests are stored.

    Raises:
        MavfiError: the mission cannot be flown.
    """

    def fly(folder: Path) -> Recorder:
        recorder = Recorder()
        fly_golden(golden, folder, recorder)
        return recorder

    return _golden_orders(golden, profiles, fly)


def _plan_fault(
    config: MissionConfig, profiles: Path, fly_golden: FlyGolden
) -> tuple[InstructionFault, dict[str, Any]]:
    """Draw a mission's fault. Return it with the entries of its record that _CONTEXT names."""
    request, golden = config.instruction, config.golden
    assert request is not None
    orders = keep_orders(golden, profiles, fly_golden)

    def plan(_armed: Callable[[], None]) -> tuple[InstructionFault, dict[str, Any]]:
        with contextlib.closing(_GoldenNode(golden, request.node(), profiles, orders)) as node:
            return node.fault(request, *node.draw(request))

    return TracerThread(plan).result()


class _GoldenNode:
    """A node of a golden flight, from which faults are drawn. Use it in a single thread only."""

    def __init__(
        self, golden: MissionConfig, node: str, profiles: Path, kept: GoldenOrders
    ) -> None:
        self._golden, self.name = golden, node
        self.kernel = kernel_of_node(node, golden.planner)
        self._folder = kept_in(profiles, golden)
        shared = (nodes for nodes in golden.loaded_stack().processes if node in nodes)
        self.process = next(shared, (node,))
        self._setup = Setup.of(golden, kept.briefing, node)
        self._given: tuple[_Given[Any], ...] = getattr(kept, node)
        self._orders = kept.of_process(self.process)
        self._rehearsal: Rehearsal | None = None

    @property
    def rehearsal(self) -> Rehearsal:
        """The rehearsal of the node, which is started when it is first used."""
        if self._rehearsal is None:
            self._rehearsal = Rehearsal(self._setup, self.name, self._orders)
        return self._rehearsal

    def close(self) -> None:
        """End the node's process, if it was started."""
        if self._rehearsal is not None:
            self._rehearsal.close()

    def draw(self, request: InstructionConfig) -> tuple[KernelInvocation, np.random.Generator]:
        """Draw the invocation to strike. Return it with the generator for the remaining draws.

        Raises:
            FaultError: the flight never enters the kernel.
        """
        entries = _kept(
            self._folder / f"entries-{self.kernel}.npz",
            _Entries,
            lambda: _Entries(counts=tuple(self.rehearsal.count_entries())),
            sound=lambda entries: len(entries.counts) == len(self._given),
        )
        counts = entries.counts
        if not counts or not counts[-1]:
            raise FaultError(
                f"the golden flight never enters {self.kernel}, so nothing in it can be struck: "
                "choose another world, seed or node"
            )
        rng = Stream.FAULT.generator(request.place_seed, "instruction")
        drawn = draw_invocation(self.name, counts, rng)
        if request.invocation_seed is not None:
            rng = Stream.FAULT.generator(request.seed, "operand")
        return drawn, rng

    def fault(
        self, request: InstructionConfig, drawn: KernelInvocation, rng: np.random.Generator
    ) -> tuple[InstructionFault, dict[str, Any]]:
        """Draw a fault in an invocation. Return it and the record's entries that _CONTEXT names."""
        strategy = replace(mission_strategy(request), whole_process=False)
        profiling = Stream.FAULT.generator(self._golden.seed, "profile", self.kernel, drawn.number)
        profile = _kept(
            self._folder / f"profile-{self.kernel}-{drawn.number}.npz",
            TargetProfile,
            lambda: replace(self.rehearsal.profile(drawn, profiling), image=None),
            sound=_is_sound,
        )
        fault = profile.draw(strategy, rng)
        context = {
            "node": self.name,
            "kernel": self.kernel,
            "invocation": drawn.number,
            "invocations": drawn.of,
            "node_invocation": drawn.order,
            "stamp_s": round(self._given[drawn.order - 1][1], 9),
            "sampling": request.sampling_name(),
            "windows": profile.windows,
            "profiled_instructions": profile.executed,
            "seed": request.seed,
            "request": request.as_dict(),
        }
        return replace(fault, corruption=None) if request.null else fault, context

    def received_alike(self, flown: GoldenOrders, drawn: KernelInvocation) -> bool:
        """Return True if another flight sent this node's process the same requests.

        The requests are compared up to the one that contains the drawn invocation.
        """
        own = [at for at, (node, *_) in enumerate(self._orders) if node == self.name]
        until = own[drawn.order - 1] + 1
        theirs = flown.of_process(self.process)[:until]
        return len(theirs) == until and all(
            pickle.dumps(mine) == pickle.dumps(other)
            for mine, other in zip(self._orders, theirs, strict=False)
        )


def struck_nodes(
    flown: MissionConfig,
    requests: Mapping[int, InstructionConfig],
    recorder: Recorder,
    *,
    profiles: Path,
    omit: Callable[[str], None] = lambda _reason: None,
) -> dict[int, StruckNode]:
    """Strike the nodes of several missions, each in a rehearsal: the node without its flight.

    Args:
        flown: the flown mission, which equals the others without their faults.
        requests: the faults, by mission number.
        recorder: recorder of the flight of `flown`. If `flown` differs from its golden mission, the
            requests of the golden mission must already be stored.
        profiles: folder that keeps golden flights and profiles.
        omit: called with the reason for each omitted fault, or once for all faults of a node.

    Returns:
        The injections by mission number. Faults that cannot be planned, or whose effect cannot be
        determined in a rehearsal, are omitted.
    """
    golden, seen = flown.golden, GoldenOrders.of(recorder)
    orders = _golden_orders(golden, profiles, lambda _: recorder)
    by_node: dict[str, list[int]] = {}
    for number, request in requests.items():
        by_node.setdefault(request.node(), []).append(number)
    injections = dict[int, StruckNode]()

    def strike(node: _GoldenNode, numbers: Sequence[int]) -> None:
        drawn = {number: node.draw(requests[number]) for number in numbers}
        for number in sorted(drawn, key=lambda number: drawn[number][0].order):
            invocation, rng = drawn[number]
            if flown != golden and not node.received_alike(seen, invocation):
                omit(f"the detector changed what node {node.name} received before the fault")
                continue
            try:
                fault, context = node.fault(requests[number], invocation, rng)
                struck = node.rehearsal.strike(fault, invocation, context)
            except (MavfiError, OSError) as error:
                omit(str(error))
            else:
                injections[number] = _StruckInjection(struck, node.name, invocation.order)

    def work(_armed: Callable[[], None]) -> None:
        for name, numbers in by_node.items():
            try:
                with contextlib.closing(_GoldenNode(golden, name, profiles, orders)) as node:
                    strike(node, numbers)
            except (MavfiError, OSError) as error:
                omit(str(error))

    TracerThread(work).result()
    return injections


def draw_invocation(node: str, counts: Sequence[int], rng: np.random.Generator) -> KernelInvocation:
    """Draw one invocation of a kernel uniformly from those of a golden run.

    Every entry is an invocation, except in a planner node. There the kernel is entered whenever an
    obstacle grid is built, at least once per request, and the request is the invocation.

    Args:
        counts: cumulative number of the kernel's entries at the end of every request to the node;
            not empty.
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
    return KernelInvocation(
        number=number, of=of, order=order + 1, entry=entry, earlier=int(before[order])
    )


def _is_sound(profile: TargetProfile) -> bool:
    """Return True if a fault can be drawn from a profile, which was read from a file."""
    segments = [segment for stratum in profile.strata for segment in stratum.segments]
    return (
        bool(segments)
        and profile.counted is None
        and all(stratum.windows_in_run >= len(stratum.segments) > 0 for stratum in profile.strata)
        and all(len(segment.trace) and profile.contains(segment.trace) for segment in segments)
    )


def _kept(
    path: Path, kind: type[T], make: Callable[[], T], *, sound: Callable[[T], bool] = lambda _: True
) -> T:
    """Read a value from its file. If the file is missing or damaged, make the value and write it.

    A new value is read back, so that this mission gets the same value as all later ones.

    Args:
        sound: Returns False for a value that this program cannot have written.
    """
    with contextlib.suppress(RecordError, ValueError):
        if sound(kept := unpack(read_bounded(path, _LARGEST), kind)):
            return kept
    data = pack(make())
    write_atomically(path, lambda file: file.write(data))
    return unpack(data, kind)


# Flight -------------------------------------------------------------------------------------------


class InstructionInjection(NoInjection):
    """Injection of one instruction-level fault in one mission. Messages pass unchanged."""

    def __init__(
        self,
        fault: InstructionFault,
        context: Mapping[str, Any],
        *,
        recorded: FaultRecord | None = None,
        for_debugger: Callable[[int], None] | None = None,
    ) -> None:
        super().__init__()
        self._fault, self._context = fault, context
        self._recorded, self._for_debugger = recorded, for_debugger
        self.node = str(context["node"])
        self._spawned = ServedProcess.of(PROGRAM)
        self._path: Path | None = None
        self._tracer: TracerThread[LiveAttack] | None = None
        self._reached = threading.Event()  # set at the trigger, or when the attack ends without it
        self._struck = False  # True once the struck invocation was answered
        self._reported = False

    @classmethod
    def plan(
        cls,
        config: MissionConfig,
        profiles: Path,
        fly_golden: FlyGolden,
        for_debugger: Callable[[int], None] | None = None,
    ) -> InstructionInjection:
        """Draw the fault of a mission from its golden flight, and return its injection.

        Args:
            profiles: Folder that keeps golden flights and profiles.
            fly_golden: Flies the golden mission if its requests are not stored yet.
            for_debugger: Called with the id of the node's process once that process waits for a
                debugger at the injected instruction.

        Raises:
            FaultError: The flight is not repeatable, or nothing in it can be struck.
        """
        if config.link is not None:
            raise FaultError(
                "an instruction-level fault needs a repeatable flight, and a flight of a foreign "
                "autopilot is not repeatable: leave out --link"
            )
        fault, context = _plan_fault(config, profiles, fly_golden)
        return cls(fault, context, for_debugger=for_debugger)

    @classmethod
    def of_record(
        cls, recorded: FaultRecord, for_debugger: Callable[[int], None] | None = None
    ) -> InstructionInjection:
        """Create the injection that repeats a recorded fault.

        Raises:
            RecordError: The record is damaged.
        """
        fault = record.fault_of(recorded)
        if missing := [name for name in _CONTEXT if name not in recorded]:
            raise RecordError(f"the fault record is damaged: it has no entry {missing[0]!r}")
        try:
            structure_record(recorded, MissionInstructionFault)
        except ValueError as error:
            raise RecordError(f"the fault record is damaged: {error}") from None
        context = {name: recorded.get(name) for name in _CONTEXT}
        return cls(fault, context, recorded=recorded, for_debugger=for_debugger)

    def begin(self, path: Path) -> None:
        """Set the path to which the tracer writes the record."""
        self._path = path

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Move the attacked node into its own process and arm the fault there.

        Raises:
            BuildMismatch: the recorded fault comes from another build.
            TracingForbidden: the operating system does not permit tracing.
        """
        scope = self._spawned.begin(Setup.of(config, briefing, self.node), f"node {self.node}")
        pid = self._spawned.pid
        if self._recorded is not None:
            record.require_same_build(self._recorded, Image(pid, scope.regions))
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
                self._fault,
                path=self._path,
                regions=scope.regions,
                window=0 if debugging else 64,
                armed=armed,
                reached=self._reached.set,
                leave_stopped=debugging,
                scope=list(scope.objects),
                **self._context,
            )
        finally:
            self._reached.set()
        if self._for_debugger is not None and done.ended is None:
            self._for_debugger(pid)
        return done

    def _ending(self) -> str | None:
        """Return how the node ended, or None if the tracer did not notice its end."""
        ended = None if self._tracer is None else self._tracer.result().ended
        return None if ended is None else ended.describe()

    def _note_strike(self) -> None:
        """Note whether the fault has struck, once the node has answered.

        The time of the call does not depend on the host's speed, so the logged tick of the strike
        does not either. If a detector changed the flight before the fault, the trigger occurs in an
        invocation other than planned, or never.
        """
        self._struck = self._struck or self._reached.is_set()

    def news(self) -> list[str]:
        """Return a description of the fault, once, after the struck invocation has ended."""
        if self._reported or self._tracer is None or not self._struck:
            return []
        self._reported = True
        done = self._tracer.result()
        return [] if self._fault.corruption is None else [record.describe(done.record)]

    def finish(self) -> dict[str, Any]:
        """Return the fault's record at the end of the mission.

        Entries that differ between repetitions of the mission are omitted.
        """
        assert self._tracer is not None
        return record.repeatable(self._tracer.result().record)

    def close(self) -> None:
        """Kill the node's process, unless an executor already owns it."""
        if self._tracer is None:
            self._spawned.kill()


class _StruckInjection(StruckNode):
    """Injection of an instruction-level fault that has struck its node in a rehearsal."""

    def __init__(self, struck: Struck, node: str, order: int) -> None:
        written = self._written = struck.record
        text = "" if written["corruption"] is None else record.describe(written)
        super().__init__(node, order, struck.effect.value, struck.process, text)
        self.how = struck.how

    def begin(self, path: Path) -> None:
        """Write the fault's record to `path`."""
        record.write(path, self._written)

    def finish(self) -> dict[str, Any]:
        """Return the fault's record, without the entries that differ between repetitions."""
        return record.repeatable(self._written)
