"""Missions that differ in their fault only fly together until it strikes.

The trunk is a flight without a fault. All faults watch it as they would watch their own flights:
each sees every message, counts, draws, and waits for its moment. Where one acts, the flight forks:
one goes on with the message as it was, the other, from then on a mission of its own, with the
struck one. Up to there a faulty flight *is* the flight without the fault, so nothing is
approximated, and the records are those of missions flown from their start.

A flight forks in the middle of a control tick, when the vehicle waits for the answer and nothing
is on the link. Companion and vehicle are then all that it consists of: one process with one thread
each, and the files of the record.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from mavfi_cli.core.types import CollisionReport, Command, Trajectory
from mavfi_cli.fi.source.activation import Follower
from mavfi_cli.fi.source.schedule import Moment
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.fault_config import FaultConfig
from mavfi_cli.mission.injection import NoInjection, SourceInjection

M = TypeVar("M", CollisionReport, Trajectory, Command)


def can_branch(config: MissionConfig) -> bool:
    """Whether a mission may fly with others up to its fault, or as the one without a fault.

    Not with nodes in processes of their own, nor by the wall clock; and a fault in a detector's
    memory, in a process or in control's copy of a plan has no message to watch.
    """
    fault = config.fault
    return (
        config.instruction is None
        and config.link is None
        and not config.realtime
        and not config.isolate
        and (
            fault is None
            or not (fault.attacks_detector or fault.killed_node or fault.strikes_queue)
        )
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """One of the missions that fly together."""

    config: MissionConfig
    out: Path  # where its run folder goes


class Branching(ABC):
    """Who this process is, among the missions that fly together; and how it becomes two.

    Attributes:
        members: the missions, at most one without a fault.
        me: index of the one that this process is; None: not known yet.
    """

    def __init__(self, members: Sequence[Member]) -> None:
        self.members = members
        self.me: int | None = next(
            (n for n, member in enumerate(members) if member.config.fault is None), None
        )

    @abstractmethod
    def become(self, member: int) -> None:
        """Be this mission from now on."""

    @abstractmethod
    def fork(self, member: int) -> bool:
        """Fork: True in the new process, which is the mission; False here."""

    @abstractmethod
    def await_fork(self) -> None:
        """Pause until the newest fork has ended."""

    @abstractmethod
    def scratch(self, member: int) -> Path:
        """A new folder for what a mission need not keep."""


class Trunk(NoInjection):
    """The faults of the missions that fly together, until each goes its own way.

    Args:
        branching: the missions.
        branch: has the flight fork for a mission; True where this is the new one.
    """

    def __init__(self, branching: Branching, branch: Callable[[int], bool]) -> None:
        self._faults: dict[int, FaultConfig] = {
            number: member.config.fault
            for number, member in enumerate(branching.members)
            if member.config.fault is not None
        }
        self._branch = branch
        self._waiting: dict[int, SourceInjection] = {}
        self._own = NoInjection()
        self.follower: Follower = Follower()  # follows nothing yet

    def prepare(self, shortest_flight_s: float) -> None:
        """Draw the faults, as soon as it is known over which time."""
        self._waiting = {
            number: SourceInjection(fault, shortest_flight_s)
            for number, fault in self._faults.items()
        }

    @property
    def left(self) -> list[int]:
        """The missions whose fault has not struck."""
        return list(self._waiting)

    def become(self, number: int) -> None:
        """Be the injection of this mission from now on."""
        self._own = own = self._waiting[number]
        self.follower = own.follower
        self._waiting = {}

    def watch(self, moment: Moment) -> None:
        """Let the triggers of all see where the flight stands."""
        for fault in (self._own, *self._waiting.values()):
            fault.watch(moment)

    def pass_on(self, message: M, moment: Moment, index: int = 0) -> M:
        """A message as its receiver gets it in this process's mission."""
        return self._offer(message, lambda fault, given: fault.pass_on(given, moment, index))

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """The trajectory that is being flown, as it is from this tick on."""
        return self._offer(
            trajectory, lambda fault, given: fault.strike_latched(given, moment, index)
        )

    def _offer(self, message: M, pass_on: Callable[[NoInjection, M], M]) -> M:
        if not self._waiting:
            return pass_on(self._own, message)
        for number, fault in list(self._waiting.items()):
            try:
                sent = pass_on(fault, message)
            except Exception:  # the boundary between missions: this one's crash is not the others'
                if self._branch(number):
                    raise
                del self._waiting[number]
                continue
            if fault.struck and self._branch(number):
                return sent
            if fault.struck:
                del self._waiting[number]
        return message

    def begin(self, path: Path) -> None:
        """Write down what is going to happen."""
        self._own.begin(path)

    def news(self) -> list[str]:
        """What was done since the last call, a line each."""
        return self._own.news()

    def finish(self) -> dict[str, Any] | None:
        """The record at the end of the mission."""
        return self._own.finish()
