"""One flight from which missions are forked, each at the moment of its own fault.

Missions that differ only in their fault fly the same way until it strikes. They fly that way
once: a process flies without a fault, and forks itself when a fault is due. The fork is the mission
from there on; the flight waits until it has ended, and continues. Missions whose fault was never
due, and those without a fault, are forked when the flight is over.

Every record is that of the mission flown alone, except its host section.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Protocol, TypeVar

from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.injection import NoInjection, SourceInjection
from mavfi_cli.companion.protection import NoProtection
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.flight_record import Strike
from mavfi_cli.core.types import Trajectory
from mavfi_cli.core.wall import WallClock
from mavfi_cli.fi.injector import Moment, NoInjector
from mavfi_cli.mission.run_folder import RunFolder
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig

M = TypeVar("M")


class _Flight(Protocol):
    """The parts of `flight.Flight` that are used here."""

    wall: WallClock
    stamp_s: float

    def take(self, config: MissionConfig, tlog: Path) -> None: ...

    def isolate_late(self, name: str) -> Executor: ...


class _Struck(Exception):
    """Ends a strike in the shared flight, whose mission has been forked and has ended."""


Branch = tuple[MissionConfig, Path]  # a mission, and the folder for its run folder


class SharedFlight(NoInjection):
    """The injection of a shared flight; in a fork, that of the fork's mission.

    Args:
        branches: missions by number, equal except for their source-level faults.
        fork: forks this process for a mission and returns True in the fork; in this process,
            returns False after the fork's end.

    Attributes:
        flight: the flight, which is set before its first message.
        config: the mission of this fork; None in the shared flight.
        folder: the fork's run folder.
        forked_s: stamp at which it was forked, s.
    """

    flight: _Flight
    folder: RunFolder

    def __init__(self, branches: Mapping[int, Branch], fork: Callable[[int], bool]) -> None:
        super().__init__()
        self._fork = fork
        self._injections = {
            number: NoInjection()
            if config.fault is None
            else _ForkedInjection(config.fault, self, number)
            for number, (config, _) in branches.items()
        }
        self._branches = branches
        self.config: MissionConfig | None = None
        self.forked_s = 0.0
        self.injector = _Injectors(self._injections)

    @property
    def _own(self) -> NoInjection | None:
        """The injection of this fork's mission."""
        return None if self.config is None else next(iter(self._injections.values()))

    @property
    def in_queue(self) -> bool:  # type: ignore[override]
        """See `NoInjection`."""
        return self._own is not None and self._own.in_queue

    def aim(self, shortest_flight_s: float, protection: NoProtection) -> None:
        """Draw the faults. A mission whose fault cannot be drawn is not forked."""
        for number, injection in list(self._injections.items()):
            try:
                injection.aim(shortest_flight_s, protection)
            except MavfiError:  # flown alone, the mission reports it
                del self._injections[number]
            injection.injector.follower = self.injector.follower  # which the companion informs

    def news(self) -> list[str]:
        """See `NoInjection`."""
        return [] if self._own is None else self._own.news()

    def finish(self) -> dict[str, object] | None:
        """See `NoInjection`."""
        return None if self._own is None else self._own.finish()

    def depart(self, number: int) -> bool:
        """Fork the flight for a mission. Return True in the fork."""
        (config, out), begun_s = self._branches[number], time.perf_counter()
        injection = self._injections.pop(number)
        if not self._fork(number):
            self.flight.wall.skipped_s += time.perf_counter() - begun_s
            return False
        self._injections.clear()
        self._injections[number] = injection
        self.config, self.forked_s = config, round(self.flight.stamp_s, 3)
        self.folder = RunFolder.new(out, config.world, config.seed)
        injection.begin(self.folder.fault)
        self.flight.take(config, self.folder.tlog)
        return True

    def end(self) -> tuple[MissionConfig, RunFolder]:
        """Fork the missions that are left. Return the mission and the run folder of this fork.

        Raises:
            SystemExit: this is the shared flight, which has no mission of its own.
        """
        if self.config is None and not any(map(self.depart, list(self._injections))):
            raise SystemExit
        assert self.config is not None
        return self.config, self.folder


class _ForkedInjection(SourceInjection):
    """A fault whose first strike forks the shared flight."""

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
    """The injectors of the missions that have not been forked; in a fork, its own alone."""

    def __init__(self, injections: dict[int, NoInjection]) -> None:
        super().__init__()
        self._injections = injections

    def _injectors(self) -> Iterator[NoInjector]:
        """Yield the injectors that are left; a fork needs no other after its own."""
        for number in list(self._injections):
            if number in self._injections:
                yield self._injections[number].injector

    def watch(self, moment: Moment) -> None:
        """See `NoInjector`."""
        for injector in self._injectors():
            injector.watch(moment)

    def pass_on(self, message: M, moment: Moment) -> M:
        """See `NoInjector`."""
        for injector in self._injectors():
            with contextlib.suppress(_Struck):
                message = injector.pass_on(message, moment)
        return message

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """See `NoInjector`."""
        for injector in self._injectors():
            with contextlib.suppress(_Struck):
                trajectory = injector.strike_latched(trajectory, moment, index)
        return trajectory

    def strike(self, moment: Moment) -> None:
        """See `NoInjector`."""
        for injector in self._injectors():
            with contextlib.suppress(_Struck):
                injector.strike(moment)
