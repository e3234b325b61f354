"""Plans one exact instruction-level fault of a mission, and injects it during the flight.

A node is a function of its orders. A rehearsal replays the orders of the golden run to a separate
node, without a flight and as fast as the machine allows. For the last order the node forks
repeatedly: a fork works on the order and exits instead of replying. Orders, numbers of kernel
entries and profiles are kept below the output folder, under a hash of everything that determines
them. In the flight a tracer thread injects the fault.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mavfi_cli.attack.attacker import EntryCounter, LiveAttack, TracerThread, attack_live
from mavfi_cli.attack.kernels.scope import KernelScope, kernel_of_node
from mavfi_cli.attack.profile import TargetProfile, profile_call, profile_calls, profile_run
from mavfi_cli.attack.served import ServedProcess
from mavfi_cli.attack.strategy import mission_strategy
from mavfi_cli.autonomy.collision import CollisionInputs
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.kernels import ControlInput
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.core.archive import pack, unpack
from mavfi_cli.core.errors import FaultError, RecordError, TargetError
from mavfi_cli.core.files import (
    own_folder,
    read_bounded,
    write_atomically,
)
from mavfi_cli.core.flight_record import SCHEMA
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import Briefing, DepthFrame, PointCloud
from mavfi_cli.fi.tracer import linux, record
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.fault import InstructionFault
from mavfi_cli.fi.tracer.image import Image, Scope
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.fi.tracer.sampling import WindowTooLong
from mavfi_cli.fi.tracer.tracee import Tracee
from mavfi_cli.mission.instruction import PROGRAM, kept_in
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.progress import Recorder
from mavfi_cli.spec.mission import MissionConfig

T = TypeVar("T")
_Order = tuple[T, float]  # input, start stamp
FlyGolden = Callable[[MissionConfig, Path, Recorder], object]  # mission, folder of runs, recorder
_CONTEXT = (
    "node", "kernel", "invocation", "invocations", "node_invocation", "stamp_s", "sampling",
    "windows", "profiled_instructions", "seed", "request",
)  # fmt: skip
_WHOLE_LIMIT = 600_000  # instructions of an invocation, or of one window
_WINDOWS, _ENOUGH = 4, 50_000  # for a planner's request with a search: see `profile_run`
_INNER_CALLS = {"octomap": 16}  # sampled calls of one inner function, about 300 instructions each


_LARGEST = 1 << 31  # bytes of a kept file


@dataclass(frozen=True, slots=True, kw_only=True)
class GoldenOrders:
    """The briefing of a golden run, and its orders by node."""

    briefing: Briefing
    point_cloud: tuple[_Order[DepthFrame], ...] = ()
    octomap: tuple[_Order[PointCloud], ...] = ()
    collision_check: tuple[_Order[CollisionInputs], ...] = ()
    planner: tuple[_Order[tuple[PlanRequest, MapSnapshot]], ...] = ()
    control: tuple[_Order[ControlInput], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Entries:
    """Cumulative number of kernel entries at the end of every order of its node."""

    counts: tuple[int, ...]

    def __post_init__(self) -> None:
        if any(later < earlier for earlier, later in pairwise((0, *self.counts))):
            raise ValueError("counts must not decrease")


def _plan_fault(
    config: MissionConfig, profiles: Path, fly_golden: FlyGolden
) -> tuple[InstructionFault, dict[str, Any]]:
    """Draw the fault of a mission, and the entries of _CONTEXT."""
    request = config.instruction
    assert request is not None
    strategy, node = mission_strategy(request), request.node()
    kernel = kernel_of_node(node, config.planner)
    golden = config.golden
    folder = own_folder(kept_in(own_folder(profiles), golden))

    def fly() -> GoldenOrders:
        recorder = Recorder()
        fly_golden(golden, folder, recorder)
        assert recorder.briefing is not None
        orders = {name: tuple(given) for name, given in recorder.orders.items()}
        return GoldenOrders(briefing=recorder.briefing, **orders)

    kept = _kept(folder / "orders.npz", GoldenOrders, fly)
    setup = Setup.of(config, kept.briefing, node)
    orders: tuple[_Order[Any], ...] = getattr(kept, node)

    def count() -> _Entries:
        with contextlib.closing(Rehearsal(setup)) as place:
            return _Entries(counts=tuple(place.count_entries(orders)))

    entries = _kept(
        folder / f"entries-{kernel}.npz",
        _Entries,
        count,
        sound=lambda entries: len(entries.counts) == len(orders),
    )
    counts = entries.counts
    if not counts or not counts[-1]:
        raise FaultError(
            f"the golden flight never enters {kernel}, so nothing in it can be struck: choose "
            "another world, seed or node"
        )
    rng = Stream.FAULT.generator(request.seed, "instruction")
    drawn = draw_invocation(node, counts, rng)
    profiling = Stream.FAULT.generator(config.seed, "profile", kernel, drawn.number)
    profile = _kept(
        folder / f"profile-{kernel}-{drawn.number}.npz",
        TargetProfile,
        lambda: replace(
            Rehearsal.profile_invocation(
                setup, orders[: drawn.order], drawn.entry, drawn.earlier, profiling
            ),
            image=None,
        ),
        sound=_is_sound,
    )
    fault = profile.draw(replace(strategy, whole_process=False), rng)
    context = {
        "node": node,
        "kernel": kernel,
        "invocation": drawn.number,
        "invocations": drawn.of,
        "node_invocation": drawn.order,
        "stamp_s": round(orders[drawn.order - 1][1], 9),
        "sampling": request.sampling_name(),
        "windows": profile.windows,
        "profiled_instructions": profile.executed,
        "seed": request.seed,
        "request": asdict(request),
    }
    return replace(fault, corruption=None) if request.null else fault, context


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

    Every entry is an invocation, except for a planner node: it is entered whenever it builds an
    obstacle grid, at least once per request, and the request is the invocation.

    Args:
        counts: cumulative entries at the end of every order of the golden run; not empty.
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


def _is_sound(profile: TargetProfile) -> bool:
    """Return True if a fault can be drawn from a profile that was read from a file."""
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
    """Read a value from its file; if the file is missing or damaged, make the value and write it.

    A new value is read back, so that this mission gets the same value as all later ones.

    Args:
        sound: Returns False for a value that this program cannot have made.
    """
    with contextlib.suppress(RecordError, ValueError):
        if sound(kept := unpack(read_bounded(path, _LARGEST), kind)):
            return kept
    data = pack(make())
    write_atomically(path, lambda file: file.write(data))
    return unpack(data, kind)


# Rehearsal ----------------------------------------------------------------------------------------


class Rehearsal:
    """The `AttackPlace` in which one invocation of a node's kernel runs.

    Args:
        orders: inputs and start stamps up to the order that contains the invocation.
        entry: number, from 1, of the kernel entry in that order that begins the invocation.
    """

    kind = "node"

    def __init__(self, setup: Setup, orders: Sequence[_Order[Any]] = (), entry: int = 1) -> None:
        self._setup, self._entry = setup, entry
        self._last = orders[-1:]
        self._spawned = ServedProcess.of(PROGRAM)
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            self.scope_of_node: KernelScope = self._spawned.begin(setup, f"node {setup.node}")
            self._process = NodeProcess(self._spawned.connection, self._spawned.pid)
            for order in orders[:-1]:
                self._work(order)
            self._image = Image(self._spawned.pid, self.scope_of_node.regions)
            undo.pop_all()

    def _work(self, order: _Order[Any]) -> None:
        self._process.take(self._process.order(self._setup.node, *order))

    def count_entries(self, orders: Sequence[_Order[Any]]) -> list[int]:
        """Count the kernel's entries up to the end of each order.

        Raises:
            TracingForbidden: the operating system allows neither counting nor tracing.
        """
        counts, address = [], self._image.address(self.scope_of_node.entry)
        with contextlib.closing(EntryCounter(self._spawned.pid, address)) as counter:
            for order in orders:
                self._work(order)
                counts.append(counter.read())
        return counts

    @property
    def name(self) -> str:
        """Name of the kernel."""
        return self.scope_of_node.kernel

    def start(self) -> Tracee:
        """Start a fork of the node, stopped where it begins the invocation."""
        tracee = Tracee.attach(self._process.rehearse())
        self._process.order(self._setup.node, *self._last[0])
        if not tracee.run_to(self._image.address(self.scope_of_node.entry), self._entry):
            raise TargetError(f"node {self._setup.node}", "does not begin its invocation again")
        return tracee

    def image(self, _: Tracee) -> Image:
        """The memory image of the node and of each fork."""
        return self._image

    def scope(self, image: Image) -> Scope:
        """The code in scope."""
        return image.scope(self.scope_of_node.objects)

    def profile(self, rng: np.random.Generator) -> TargetProfile:
        """Step the invocation, or a sample of it.

        Stepping runs on the node's processor, because switching between two doubles the time.
        """
        linux.share_processor(self._spawned.pid)
        node, inner = self._setup.node, self.scope_of_node.inner
        if node in _INNER_CALLS:
            return profile_calls(self, rng, inner, windows=_INNER_CALLS[node], limit=_WHOLE_LIMIT)
        if node != "planner":
            return profile_call(self, limit=_WHOLE_LIMIT)
        # No native function encloses a request: Python calls several compiled functions, with or
        # without a search, which begins with the first of `inner`. So the request ends with the
        # run. It is stepped whole if it needs no search.
        tracee = self.start()
        try:
            searches = tracee.count_to_end(self._image.address(inner[0])) > 0
        finally:
            tracee.kill()
        if not searches:
            with contextlib.suppress(WindowTooLong):  # smoothing repeats its attempts
                return profile_run(self, rng, limit=_WHOLE_LIMIT)
        several: Any = {"markers": inner, "windows": _WINDOWS, "enough": _ENOUGH}
        return profile_run(self, rng, **several, limit=_WHOLE_LIMIT)

    @classmethod
    def profile_invocation(
        cls,
        setup: Setup,
        orders: Sequence[_Order[Any]],
        entry: int,
        earlier: int,
        rng: np.random.Generator,
    ) -> TargetProfile:
        """Profile one invocation of a node's kernel in the last of the orders.

        Args:
            orders: the orders up to the one that contains the invocation.
            entry: number of the kernel entry that begins the invocation, from 1.
            earlier: number of kernel entries in the earlier orders.
            rng: draws the sample, if only a sample is stepped.

        Raises:
            TracingForbidden: the operating system refuses.
            WindowTooLong: the invocation is too long to be stepped.
            TargetError: nothing in scope executes.
        """
        with contextlib.closing(cls(setup, orders, entry - earlier)) as place:
            profile = TracerThread(lambda _armed: place.profile(rng)).result()
        return profile.after(CountedStop(place.scope_of_node.entry, entry))

    def close(self) -> None:
        """End the node."""
        self._spawned.kill()


# Flight -------------------------------------------------------------------------------------------


class InstructionInjection(NoInjection):
    """One instruction-level fault in one mission; messages pass unchanged."""

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
        self._reached = threading.Event()  # the trigger, or the end of the attack without it
        self._struck = False  # in an invocation whose answer is there
        self._reported = False

    @classmethod
    def plan(
        cls,
        config: MissionConfig,
        profiles: Path,
        fly_golden: FlyGolden,
        for_debugger: Callable[[int], None] | None = None,
    ) -> InstructionInjection:
        """Draw the fault of a mission from its golden flight.

        Args:
            profiles: Folder of golden flights and profiles.
            fly_golden: Flies the golden mission, if its orders are not kept yet.

        Raises:
            FaultError: The flight is not repeatable, or nothing in it can be struck.
        """
        if config.link is not None:
            raise FaultError(
                "an instruction-level fault needs flights that repeat, and those of a foreign "
                "autopilot do not: leave out --link"
            )
        fault, context = _plan_fault(config, profiles, fly_golden)
        return cls(fault, context, for_debugger=for_debugger)

    @classmethod
    def of_record(
        cls, recorded: FaultRecord, for_debugger: Callable[[int], None] | None = None
    ) -> InstructionInjection:
        """Repeat the fault of a record.

        Raises:
            RecordError: The record is damaged.
        """
        fault = record.fault_of(recorded)
        if missing := [name for name in _CONTEXT if name not in recorded]:
            raise RecordError(f"the fault record is damaged: it has no {missing[0]!r}")
        context = {name: recorded.get(name) for name in _CONTEXT}
        return cls(fault, context, recorded=recorded, for_debugger=for_debugger)

    def begin(self, path: Path) -> None:
        """Set the path to which the tracer writes the record."""
        self._path = path

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Move the attacked node into its own process and arm the fault there.

        Raises:
            BuildMismatch: the repeated record is of another build.
            TracingForbidden: the operating system refuses.
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
        """Return how the node ended, if the tracer noticed it."""
        ended = None if self._tracer is None else self._tracer.result().ended
        if ended is None:
            return None
        if ended.signal is not None:
            return f"killed by {signal.Signals(ended.signal).name}"
        return f"ended with code {ended.exit_code}"

    def _note_strike(self) -> None:
        """Check for a strike between two inputs, so that its tick does not depend on speed.

        If a detector changed the flight before the fault, the trigger comes in another invocation
        than planned, or never.
        """
        self._struck = self._struck or self._reached.is_set()

    def news(self) -> list[str]:
        """Describe the fault once the struck invocation has ended."""
        if self._reported or self._tracer is None or not self._struck:
            return []
        self._reported = True
        done = self._tracer.result()
        return [] if self._fault.corruption is None else [_attack_text(done.record)]

    def finish(self) -> dict[str, Any]:
        """Return the record at the end of the mission, which is the same in every repetition."""
        assert self._tracer is not None
        written = self._tracer.result().record
        injection = {k: v for k, v in written["injection"].items() if k != "stop_s"}
        reason = written.get("not_injected_reason", "")
        state = "applied" if injection["applied"] else "not_injected"
        if written["corruption"] is None and not reason:
            state = "null"
        ending = {"schema": SCHEMA, "state": state, "reason": reason, "injection": injection}
        return {**written, **ending}

    def close(self) -> None:
        """End the node's process if no executor owns it."""
        if self._tracer is None:
            self._spawned.kill()


def _attack_text(written: FaultRecord) -> str:
    place = written["symbol"] or f"{written['object']}+{written['offset']:#x}"
    where = f"{written['kernel']}, {written['instruction']} at {place}"
    if not written["injection"]["applied"]:
        return f"fault in {where}: not injected ({written.get('not_injected_reason', '')})"
    corruption = written["corruption"]
    assert corruption is not None
    bits = ", ".join(map(str, corruption["bits"]))
    what = corruption["register"] or corruption["site"]
    activation = written["activation"]["activation"].replace("_", " ")
    return f"fault in {where}: bit {bits} of {corruption['role']} {what}, {activation}"
