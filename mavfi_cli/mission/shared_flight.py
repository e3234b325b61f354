"""One flight from which missions are forked, each at the moment of its own fault.

Missions that differ only in their fault, and in how they restart lost nodes, are identical until
the fault strikes. This common part is flown once: a process flies without a fault, and forks itself
when a fault is due. The fork continues as the mission; the flight waits until the fork has ended,
and then continues. Missions whose fault was never due, and those without a fault, are forked when
the flight is over.

An instruction-level fault is injected after the flight, in a rehearsal of its node. If it is
masked, its mission is also forked at the end of the flight. Otherwise the same flight is repeated
up to the last of these faults. The mission is forked when its node begins the struck invocation,
and continues with the struck node, or with the loss of a node that has ended. If several faults end
a node in the same invocation in the same way, one further flight includes this loss, and their
missions are forked at its end.

Every record equals that of the mission flown alone, except in its host section.
"""

from __future__ import annotations

import bisect
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.injection import NoInjection, SourceInjection, StruckNode
from mavfi_cli.companion.protection import NoProtection
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.flight_record import Strike
from mavfi_cli.core.types import FloatArray, Trajectory
from mavfi_cli.core.wall import WallClock
from mavfi_cli.fi.injector import Moment, NoInjector
from mavfi_cli.mission.progress import FlightLogger, Recorder
from mavfi_cli.mission.run_folder import RunFolder
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

if TYPE_CHECKING:
    from mavfi_cli.companion.node_process import NodeProcess
    from mavfi_cli.companion.pipeline import Companion

_CALLED = "control"  # the node that answers within the tick of its request
M = TypeVar("M")


class _Flight(Protocol):
    """The attributes and methods of `flight.Flight` that a shared flight uses."""

    wall: WallClock
    stamp_s: float
    logger: FlightLogger
    companion: Companion | None

    @property
    def place_enu_m(self) -> FloatArray: ...

    def take(self, config: MissionConfig, tlog: Path) -> None: ...

    def lose_nodes_as(self, config: MissionConfig) -> None: ...

    def isolate_late(self, name: str, process: NodeProcess | None = None) -> Executor: ...


StrikeNodes = Callable[
    [MissionConfig, Mapping[int, InstructionConfig], Recorder], Mapping[int, StruckNode]
]


class _Struck(Exception):
    """Raised to end a strike in the shared flight, after its mission was forked and has ended."""


Branch = tuple[MissionConfig, Path]  # a mission, and the parent of its run folder


class SharedFlight(NoInjection):
    """The injection of a shared flight. In a fork, it is the injection of the fork's mission.

    Args:
        branches: missions by number, equal except for their faults and how they restart nodes.
        fork: forks this process for a mission and returns True in the fork; in this process,
            returns False after the fork's end.
        strike: strikes nodes in rehearsals, for missions with instruction-level faults; receives
            the flown mission, the faults by number, and the recorder of the flight.
        omit: called with the reason for each fault that cannot be drawn.

    Attributes:
        flight: the flight; set before its first message.
        config: the mission of this fork; None in the shared flight.
        folder: the fork's run folder.
        host: entries of the host section of the fork's record.
        recorder: records the requests to the nodes; None without instruction-level faults.
    """

    flight: _Flight
    folder: RunFolder

    def __init__(
        self,
        branches: Mapping[int, Branch],
        fork: Callable[[int], bool],
        strike: StrikeNodes | None = None,
        omit: Callable[[str], None] = lambda _reason: None,
    ) -> None:
        super().__init__()
        self._fork, self._strike_nodes, self._omit = fork, strike, omit
        self._requests = {
            number: config.instruction
            for number, (config, _) in branches.items()
            if config.instruction is not None
        }
        self.recorder = Recorder() if self._requests else None
        self._struck: dict[int, StruckNode] = {}  # struck nodes that need a further flight
        self._ticks: list[tuple[float, int, FloatArray]] = []  # stamp, number of events, position
        self._injections = {
            number: NoInjection()
            if config.fault is None
            else _ForkedInjection(config.fault, self, number)
            for number, (config, _) in branches.items()
            if number not in self._requests
        }
        self._branches = branches
        self.config: MissionConfig | None = None
        self.host: dict[str, Any] = {}
        self.injector = _Injectors(self._injections)

    @property
    def _own(self) -> NoInjection | None:
        """The injection of this fork's mission, or None in the shared flight."""
        return None if self.config is None else next(iter(self._injections.values()))

    @property
    def in_queue(self) -> bool:  # type: ignore[override]
        """True in a fork whose mission has its injection site in control's copy of the plan."""
        return self._own is not None and self._own.in_queue

    def aim(self, shortest_flight_s: float, protection: NoProtection) -> None:
        """Draw the source-level faults. A mission whose fault cannot be drawn is not forked."""
        for number, injection in list(self._injections.items()):
            try:
                injection.aim(shortest_flight_s, protection)
            except MavfiError as error:  # flown alone, the mission reports it
                del self._injections[number]
                self._omit(str(error))
            injection.injector.follower = self.injector.follower  # which the companion updates

    def news(self) -> list[str]:
        """Return the new lines of text about the fault of this fork; none in the shared flight."""
        if self._own is not None:
            return self._own.news()
        if self._requests and self.recorder is not None and self.recorder.sequence:
            flight = self.flight
            self._ticks.append((flight.stamp_s, len(flight.logger.events), flight.place_enu_m))
        return []

    def finish(self) -> dict[str, object] | None:
        """Write and return the record of this fork's fault, or None if it has no fault."""
        return None if self._own is None else self._own.finish()

    def depart(self, number: int) -> bool:
        """Fork the flight for a mission. Return True in the fork and False in the shared flight.

        In the shared flight, the call returns only after the fork has ended.
        """
        (config, out), begun_s = self._branches[number], time.perf_counter()
        injection = self._injections.pop(number)
        if not self._fork(number):
            self.flight.wall.skipped_s += time.perf_counter() - begun_s
            return False
        self._injections.clear()
        self._injections[number] = injection
        self.config, self.host["forked_s"] = config, round(self.flight.stamp_s, 3)
        self.folder = RunFolder.new(out, config.world, config.seed)
        injection.begin(self.folder.fault)
        self.flight.take(config, self.folder.tlog)
        return True

    def end(self) -> tuple[MissionConfig, RunFolder]:
        """Fork the missions that are left. In a fork, return its mission and its run folder.

        Raises:
            SystemExit: this is the shared flight, which has no mission of its own.
        """
        if self.config is None:
            struck = self._strike()
            self._injections |= struck
            number = next(filter(self.depart, list(self._injections)), None)
            if number is None:
                raise SystemExit
            if number in struck:
                self._log_strike(struck[number])
        assert self.config is not None
        return self.config, self.folder

    def further(self) -> Iterator[SharedFlight]:
        """Yield the further flights for missions whose fault changed, ended or hung a node."""
        deaths: dict[tuple[object, ...], dict[int, StruckNode]] = {}
        for number, node in self._struck.items():
            how = node.how or f"fault {number}"  # no two faults change a node in the same way
            config, _ = self._branches[number]
            rules = config.node_restart_s, config.node_watchdog_s
            deaths.setdefault((node.node, node.order, how, rules), {})[number] = node
        alone = dict[int, StruckNode]()
        for struck in deaths.values():
            if len(struck) == 1:
                alone |= struck
            else:
                yield _LostFlight(self._of(struck), self._fork, struck)
        if alone:
            yield _StruckFlight(self._of(alone), self._fork, alone)

    def _of(self, numbers: Iterable[int]) -> dict[int, Branch]:
        return {number: self._branches[number] for number in numbers}

    def _strike(self) -> dict[int, StruckNode]:
        """Inject the instruction-level faults in rehearsals. Return the nodes that masked theirs.

        They are keyed by mission number. The other nodes are kept for further flights.
        """
        if self._strike_nodes is None or self.recorder is None or not self.recorder.sequence:
            return {}
        config, _ = next(iter(self._branches.values()))
        flown = config.shared_flight
        assert flown is not None
        struck = self._strike_nodes(flown, self._requests, self.recorder)
        self._struck = {number: node for number, node in struck.items() if node.process is not None}
        return {number: node for number, node in struck.items() if node.process is None}

    def _log_strike(self, injection: StruckNode) -> None:
        """Log the strike at the tick that received the answer of the struck invocation."""
        self.host["struck"] = injection.effect
        assert self.flight.companion is not None
        timetable = self.flight.companion.executor.timetable
        runs = [run for run in timetable if run.node == injection.node]
        run = runs[injection.order - 1]
        due_s = run.start_s if run.node == _CALLED else run.end_s
        at = bisect.bisect_left(self._ticks, due_s, key=lambda tick: tick[0])
        injection.note_answer()
        for stamp_s, place, position_enu_m in self._ticks[at : at + 1]:
            logger = self.flight.logger
            logger.events[place:place] = (
                logger.event(stamp_s, "fault", text, position_enu_m) for text in injection.news()
            )


class _FurtherFlight(SharedFlight):
    """A repetition of the shared flight, with nodes that were struck in rehearsals."""

    def __init__(
        self,
        branches: Mapping[int, Branch],
        fork: Callable[[int], bool],
        struck: Mapping[int, StruckNode],
    ) -> None:
        super().__init__(branches, fork)
        self._requests.clear()
        self._left = dict(struck)
        self._injections |= struck
        self.recorder = _Starts(self._lose)

    def _lose(self, node: str, order: int) -> None:
        """Handle the start of a node's invocation, given its number, from 1."""


class _StruckFlight(_FurtherFlight):
    """A repetition of the shared flight, up to the last request in which a node was struck."""

    def _lose(self, node: str, order: int) -> None:
        """Fork the missions whose node was struck in this request.

        Raises:
            SystemExit: this is the shared flight, and no mission is left.
        """
        for number, injection in list(self._left.items()):
            if (injection.node, injection.order) == (node, order):
                del self._left[number]
                if self.depart(number):
                    self._left.clear()
                    self.host["struck"] = injection.effect
                    self.flight.isolate_late(node, injection.process)
                    return
                if injection.process is not None:
                    injection.process.close(kill=True)
        if self.config is None and not self._left:
            raise SystemExit

    def end(self) -> tuple[MissionConfig, RunFolder]:
        """Return the mission and run folder of this fork.

        Raises:
            SystemExit: this is the shared flight. Missions that were not forked are flown alone.
        """
        if self.config is None:
            raise SystemExit
        return self.config, self.folder


class _LostFlight(_FurtherFlight):
    """A repetition of the shared flight that includes the loss of a node.

    Several faults cause this same loss, so their missions share this flight.
    """

    _text = ""  # text of the logged strike

    @property
    def _first(self) -> StruckNode:
        """The first struck node, whose strike the flight logs."""
        return next(iter(self._left.values()))

    def _lose(self, node: str, order: int) -> None:
        """If this is the invocation in which the faults ended the node, let the node end here."""
        if (self._first.node, self._first.order) == (node, order):
            self.flight.lose_nodes_as(next(iter(self._branches.values()))[0])
            self.flight.isolate_late(node, self._first.process)

    def news(self) -> list[str]:
        """Return the new lines of text about the first fault; none in a fork."""
        news = self._first.news() if self.config is None else []
        self._text = "".join(news) or self._text
        return news

    def end(self) -> tuple[MissionConfig, RunFolder]:
        """Fork all missions, as `SharedFlight.end` does. Each fork logs its own fault's strike."""
        assert self.flight.companion is not None
        executor = self.flight.companion.executor
        executor.settle()  # the forks cannot share the processes of its nodes
        executor.close()
        config, folder = super().end()
        (own,) = (node for node in self._injections.values() if isinstance(node, StruckNode))
        self.host["struck"] = own.effect
        if own is not self._first:
            own.note_answer()
            events = self.flight.logger.events
            events[:] = [
                replace(event, text=text)
                if (event.kind, event.text) == ("fault", self._text)
                else event
                for text in own.news()
                for event in events
            ]
        return config, folder


class _Starts(Recorder):
    """Counts the invocations of each node, and reports the number of each one when it starts."""

    def __init__(self, report: Callable[[str, int], None]) -> None:
        super().__init__()
        self._report, self._counts = report, Counter[str]()

    def on_start(self, node: str, value: object, start_s: float) -> None:
        """Report the start of an invocation: the node, and the invocation's number from 1."""
        self._counts[node] += 1
        self._report(node, self._counts[node])


class _ForkedInjection(SourceInjection):
    """Injection of a source-level fault whose first strike forks the shared flight."""

    def __init__(self, config: FaultConfig, shared: SharedFlight, number: int) -> None:
        super().__init__(config)
        self._shared, self._number = shared, number

    def _on_strike(self, strike: Strike) -> None:
        if self._shared.config is None:
            if not self._shared.depart(self._number):
                raise _Struck
            if self._config.killed_node is not None:
                self._executor = self._shared.flight.isolate_late(self._config.killed_node)
        super()._on_strike(strike)


class _Injectors(NoInjector):
    """The injectors of all missions that have not been forked. In a fork, only its own injector."""

    def __init__(self, injections: dict[int, NoInjection]) -> None:
        super().__init__()
        self._injections = injections

    def _injectors(self) -> Iterator[NoInjector]:
        """Yield the injectors of the remaining missions. In a fork, stop after the fork's own."""
        for number in list(self._injections):
            if number in self._injections:
                yield self._injections[number].injector

    def watch(self, moment: Moment) -> None:
        """Have every injector check its trigger at this moment."""
        for injector in self._injectors():
            injector.watch(moment)

    def pass_on(self, message: M, moment: Moment) -> M:
        """Return a published message, corrupted if this is a fork whose fault strikes it."""
        for injector in self._injectors():
            with contextlib.suppress(_Struck):
                message = injector.pass_on(message, moment)
        return message

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """Return the active plan, corrupted if this is a fork whose fault strikes it."""
        for injector in self._injectors():
            with contextlib.suppress(_Struck):
                trajectory = injector.strike_latched(trajectory, moment, index)
        return trajectory

    def strike(self, moment: Moment) -> None:
        """Have every injector strike memory or a process if its fault is due."""
        for injector in self._injectors():
            with contextlib.suppress(_Struck):
                injector.strike(moment)
