"""The slot's watch over one order: the missions that begin as one process, each to its end.

The process that is forked for the order is one of the missions, or becomes one, or none; others
branch off it, one at a time, and it pauses meanwhile. Each tells its pid on a pipe of its own when
it has become a mission, and later its last words.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn

from mavfi_cli.core.processes import end_children

_READ = 1 << 16
UNBORN = "the flight that it was to branch off ended before"


@dataclass(slots=True, eq=False)
class _Process:
    """A child of the slot."""

    pid: int
    begun_s: float
    away_s: float = 0.0  # it paused so long
    late: bool = False  # its time ran out
    status: int | None = None
    ended_s: float = 0.0
    descriptor: int = -1

    def __post_init__(self) -> None:
        self.descriptor = os.pidfd_open(self.pid)

    def reap(self) -> None:
        """Take its exit status, once it has ended."""
        os.close(self.descriptor)
        _, self.status = os.waitpid(self.pid, 0)
        self.ended_s = time.monotonic()

    @property
    def wall_s(self) -> float:
        """From its begin to its end, without the time in which it waited for its branches, s."""
        return self.ended_s - self.begun_s - self.away_s


@dataclass(slots=True, eq=False)
class _Mission:
    """One mission, as far as the slot has heard of it."""

    number: int
    reading: int
    process: _Process | None = None
    said: bytearray = field(default_factory=bytearray)
    told: bool = False  # the runner knows how it ended

    def hear(self) -> bool:
        """Read what it said; False at the end of the pipe."""
        data = os.read(self.reading, _READ)
        self.said += data
        return bool(data)

    def words(self) -> list[Any]:
        """Whole lines only: a mission may have been killed in the middle of one."""
        found = []
        for line in bytes(self.said).split(b"\n")[:-1]:
            try:
                found.append(json.loads(line))
            except ValueError:
                break
        return found


class Keeper:
    """Keeps the missions of one order.

    Args:
        order: of the runner.
        channel: to the runner, which is told of everything on it.
        perform: the whole life of the order's process, with a pipe for each mission.
        settle: ends what is left when all of it is over.
    """

    def __init__(
        self,
        order: Mapping[str, Any],
        channel: socket.socket,
        perform: Callable[[list[int]], NoReturn],
        settle: Callable[[], None],
    ) -> None:
        self._channel, self._limit_s, self._settle = channel, float(order["limit_s"]), settle
        begun_s = time.monotonic()
        pipes = [os.pipe() for _ in order["missions"]]
        pid = os.fork()
        if pid == 0:
            channel.close()
            for reading, _ in pipes:
                os.close(reading)
            perform([writing for _, writing in pipes])
        for _, writing in pipes:
            os.close(writing)
        self._missions = [
            _Mission(mission["number"], reading)
            for mission, (reading, _) in zip(order["missions"], pipes, strict=True)
        ]
        self._trunk = _Process(pid, begun_s)
        self._alive = [self._trunk]  # the last is the one that is not paused
        if len(self._missions) == 1:
            self._begin(self._missions[0], self._trunk)
        self._poller = select.poll()
        for descriptor in (channel.fileno(), self._trunk.descriptor, *(r for r, _ in pipes)):
            self._poller.register(descriptor, select.POLLIN)

    def keep(self) -> None:
        """Until all of it is over, and the runner knows."""
        while self._alive:
            self._look()
        self._settle()
        for mission in self._missions:
            self._report(mission)
            os.close(mission.reading)

    def _look(self) -> None:
        active = self._alive[-1]
        left_s = active.begun_s + active.away_s + self._limit_s - time.monotonic()
        if left_s <= 0.0 and not active.late:
            active.late = True
            os.kill(active.pid, signal.SIGKILL)
        ready = {fd for fd, _ in self._poller.poll(max(0.0, min(left_s, 3600.0)) * 1e3)}
        if self._channel.fileno() in ready:  # nothing is said meanwhile: the other end has closed
            end_children()
            os._exit(0)
        for mission in self._missions:
            if mission.reading in ready:
                if not mission.hear():
                    self._poller.unregister(mission.reading)
                self._note_birth(mission)
        for process in [each for each in self._alive if each.descriptor in ready]:
            self._end(process)

    def _note_birth(self, mission: _Mission) -> None:
        words = mission.words()
        if mission.process is not None or not words:
            return
        pid = words[0]["pid"]
        if pid == self._trunk.pid:
            self._begin(mission, self._trunk)
            return
        branched = _Process(pid, time.monotonic())
        self._alive.append(branched)
        self._poller.register(branched.descriptor, select.POLLIN)
        self._begin(mission, branched)

    def _begin(self, mission: _Mission, process: _Process) -> None:
        mission.process = process
        self._channel.send(json.dumps({"number": mission.number, "pid": process.pid}).encode())

    def _end(self, process: _Process) -> None:
        self._poller.unregister(process.descriptor)
        self._alive.remove(process)
        process.reap()
        self._hear_all()
        if process is self._trunk:
            return
        self._trunk.away_s += process.wall_s
        (mission,) = [each for each in self._missions if each.process is process]
        if process.status == 0:  # its vehicle has ended before it; else that is known at the end
            self._report(mission)

    def _hear_all(self) -> None:
        """Take what waits in the pipes."""
        for mission in self._missions:
            while select.select([mission.reading], [], [], 0.0)[0] and mission.hear():
                pass
            self._note_birth(mission)

    def _report(self, mission: _Mission) -> None:
        if mission.told:
            return
        mission.told = True
        ended: dict[str, Any] = {"number": mission.number, "report": None}
        process = mission.process
        if process is None or process.status is None:
            ended["lost"] = UNBORN
        else:
            ended["report"] = next(iter(mission.words()[1:]), None)
            if process.late:
                ended["timeout"] = True
            elif os.WIFSIGNALED(process.status):
                ended["signal"] = os.WTERMSIG(process.status)
            else:
                ended["exit"] = os.WEXITSTATUS(process.status)
            ended["wall_s"] = round(process.wall_s, 6)
        self._channel.send(json.dumps(ended).encode())
