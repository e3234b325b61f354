"""One flight and what belongs to it: its other end, its run folder; and how it becomes two."""

from __future__ import annotations

import contextlib
import datetime
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mavfi_cli.autonomy import is_compiled, warm_up
from mavfi_cli.core.errors import MavfiError, VehicleProcessError
from mavfi_cli.link.transport import Transport, open_transport
from mavfi_cli.mission.branching import Branching, Trunk
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.flight import Flight
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.record.run_folder import RunFolder, new_run_folder, stem_of
from mavfi_cli.mission.vehicle_process import VehicleProcess
from mavfi_cli.mission.vehicle_template import VehicleTemplate

COMPILING = "compiling the kernels, once on this machine: this takes a while"


@dataclass(slots=True, eq=False)
class OtherEnd:
    """What is at the other end of the link: a simulated vehicle of our own, or somebody else's.

    Attributes:
        truth_folder: where our vehicle leaves briefing and truth.
        process: of our vehicle.
    """

    transport: Transport
    truth_folder: Path | None = None
    process: VehicleProcess | None = None

    def failure(self) -> MavfiError | None:
        """After the link was closed: what our vehicle said when it ended with an error."""
        if self.process is None:
            return None
        self.process.stop()
        return self.process.failure()

    def change_to(self, twin: VehicleProcess, truth_folder: Path) -> None:
        """Speak to another vehicle from now on, over the same descriptor."""
        assert self.process is not None
        link = twin.detach()
        os.set_blocking(link, False)
        os.dup2(link, self.transport.fileno(), inheritable=False)
        os.close(link)
        self.process.close()
        self.process, self.truth_folder = twin, truth_folder

    def close(self) -> None:
        """End it, and remove what it left."""
        self.transport.close()
        if self.process is not None:
            self.process.stop()
            self.process.close()
        if self.truth_folder is not None:
            shutil.rmtree(self.truth_folder, ignore_errors=True)


@contextlib.contextmanager
def other_end(
    config: MissionConfig,
    vehicles: VehicleTemplate | None,
    watcher: Watcher,
    *,
    patient: bool = False,
) -> Iterator[OtherEnd]:
    """A foreign autopilot where the mission names one, else a simulated vehicle that starts.

    Args:
        config: the mission.
        vehicles: forks the simulated vehicle; None: it is started as a program.
        watcher: is told where the kernels must be compiled first.
        patient: it may have to wait long for an answer.
    """
    if config.link is not None:
        _warm_up(watcher)  # first: what comes meanwhile would be stale, and the link full of it
        with contextlib.closing(OtherEnd(open_transport(config.link))) as foreign:
            yield foreign
        return
    folder = Path(tempfile.mkdtemp(prefix="mavfi-"))
    try:
        process = VehicleProcess(config, folder, vehicles, patient=patient)
        transport = open_transport(f"fd:{process.detach()}")
    except MavfiError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    with contextlib.closing(OtherEnd(transport, folder, process)) as ours:
        _warm_up(watcher)  # while the vehicle starts
        yield ours


def _warm_up(watcher: Watcher) -> None:
    if not is_compiled():
        watcher.on_note(COMPILING)
    warm_up()


@dataclass(slots=True, eq=False)
class Sortie:
    """A mission from its flight to its record; a fork of it may become another mission.

    Attributes:
        config: the mission.
        out: where its run folder goes.
        folder: the run folder, from `begin` on.
        started, begun_s: when the work on it began.
        flight_begun_s: when the flight began, or branched off.
        flight_wall_s: host time of the flight, or of what this mission flew of it by itself.
        branched_s: simulated time at which it branched off; None: it flew all the way.
        paused_s: host time during which it waited for those that branched off.
    """

    config: MissionConfig
    out: Path
    end: OtherEnd
    flight: Flight
    branching: Branching | None = None
    folder: RunFolder = field(default_factory=lambda: RunFolder(Path()))
    started: datetime.datetime = field(default_factory=lambda: datetime.datetime.now(datetime.UTC))
    begun_s: float = field(default_factory=time.perf_counter)
    flight_begun_s: float = 0.0
    flight_wall_s: float = 0.0
    branched_s: float | None = None
    paused_s: float = 0.0

    def prepare_to_branch(self) -> None:
        """Before the briefing: let the faults of all missions watch the flight."""
        if self.branching is not None:
            self.flight.injection = Trunk(self.branching, self.branch)

    def begin(self) -> None:
        """Make the run folder, and note what is going to be injected."""
        name = stem_of(self.config.world) if self.config.link is None else "link"
        self.folder = new_run_folder(self.out, f"{name}-{self.config.seed}")
        self.flight.injection.begin(self.folder.fault)

    def note_end(self) -> None:
        """The flight is over."""
        self.flight_wall_s = time.perf_counter() - self.flight_begun_s - self.paused_s

    def branch(self, number: int) -> bool:
        """The fault of a mission has struck: True where that mission is flown from here on.

        Where the vehicle does not branch, the mission is left out.

        Raises:
            RecordError: the mission's run folder cannot be written.
        """
        branching, process = self.branching, self.end.process
        assert branching is not None
        assert process is not None
        if self._is_last(number):
            branching.become(number)
            self._be(number)
            self.flight.link.go_on_in(self.folder.tlog)
            return True
        truth_folder = branching.scratch(number)
        try:
            twin = process.branch(truth_folder)
        except VehicleProcessError:
            return False
        paused_s = time.perf_counter()
        if branching.fork(number):
            self._start_anew()
            self.end.change_to(twin, truth_folder)
            self._be(number)
            self.flight.link.go_on_in(self.folder.tlog)
            return True
        os.close(twin.detach())  # else its vehicle would not hear the end of the link
        twin.close()
        branching.await_fork()
        self.paused_s += time.perf_counter() - paused_s
        return False

    def branch_rest(self) -> None:
        """After the flight: missions whose fault never struck flew the same."""
        trunk, branching = self.flight.injection, self.branching
        if branching is None or not isinstance(trunk, Trunk):
            return
        flown = self.folder.tlog
        for number in trunk.left:
            last = self._is_last(number)
            if last:
                branching.become(number)
            elif branching.fork(number):
                self._start_anew()
                self.end.truth_folder = None  # it belongs to the other
            else:
                branching.await_fork()
                continue
            self._be(number)
            shutil.copyfile(flown, self.folder.tlog)
            return

    def _is_last(self, number: int) -> bool:
        """Whether the flight has no mission of its own, and no other can become it any more."""
        trunk = self.flight.injection
        assert self.branching is not None
        assert isinstance(trunk, Trunk)
        return self.branching.me is None and trunk.left == [number]

    def _be(self, number: int) -> None:
        assert self.branching is not None
        trunk = self.flight.injection
        assert isinstance(trunk, Trunk)
        member = self.branching.members[number]
        self.config, self.out = member.config, member.out
        trunk.become(number)
        self.begin()

    def _start_anew(self) -> None:
        """Of the host's time, what follows is this mission's."""
        self.started = datetime.datetime.now(datetime.UTC)
        self.begun_s = self.flight_begun_s = time.perf_counter()
        self.flight_wall_s = 0.0
        self.branched_s = self.flight.stamp_s
        self.paused_s = 0.0
        self.flight.wall.totals.clear()
