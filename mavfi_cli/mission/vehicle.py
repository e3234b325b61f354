"""The simulated vehicle of a mission, in the mission's process or in another.

Either way, companion and vehicle exchange bytes over a MAVLink link. The vehicle provides its
briefing before its first message and the referee's truth at the end: as objects in this process, or
as files from another. No other module on the companion's side imports the vehicle's code.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.errors import Interrupted, MavfiError, VehicleProcessError, described
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.fork_server import die_with
from mavfi_cli.core.frames import is_within
from mavfi_cli.core.processes import PYTHON
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import Briefing, FlightTruth
from mavfi_cli.link.transport import Transport, open_transport, signing_from_file
from mavfi_cli.mission.run_folder import BRIEFED, BRIEFING
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.mission import HIGHEST_M, LOWEST_M, OWN_AUTOPILOT, REMOTE_M, MissionConfig

_START_LIMIT_S = 120.0  # long enough for the first start of a camera, which compiles
_END_LIMIT_S = 20.0
_LOOK_S = 0.2


class Vehicle(ABC):
    """A simulated vehicle.

    Attributes:
        link: The companion's end of the link.
        truth: The referee's log; None before the end, or if the vehicle died.
        depth: Path of the Unix domain socket that sends depth frames as arrays to a user's
            companion that requests it; None unless mavfi started the vehicle's process.
    """

    link: Transport
    truth: FlightTruth | None = None
    depth: Path | None = None

    @staticmethod
    def start(config: MissionConfig) -> Vehicle:
        """Start the vehicle in this process, or in a separate one for flights on the wall clock."""
        by_wall = config.realtime or config.companion is not None
        return (VehicleProcess if by_wall else VehicleInProcess)(config)

    @staticmethod
    def start_in_lockstep(config: MissionConfig) -> Vehicle:
        """Start the vehicle in a separate process, in lockstep with a user's companion."""
        return _LockstepProcess(config)

    @staticmethod
    def at(url: str, briefing: Path) -> StartVehicle:
        """Return a function that connects to a vehicle that another process runs in lockstep.

        Args:
            url: Endpoint of the link to the vehicle.
            briefing: File to which the other process has written the vehicle's briefing.
        """
        return lambda _: _VehicleElsewhere(url, briefing)

    @abstractmethod
    def briefing(self) -> Briefing:
        """Return the vehicle's briefing: start, goal, flight bounds and camera mount.

        Raises:
            VehicleProcessError: The vehicle has written no valid briefing.
        """

    @staticmethod
    def read_briefing(path: Path) -> Briefing:
        """Read the briefing from the file to which the vehicle's process has written it.

        Raises:
            VehicleProcessError: The briefing is missing or damaged.
        """
        try:
            data = json.loads(path.read_text())
            arrays: Any = {name: np.array(data[name], np.float64) for name in BRIEFED}
            for name, values in arrays.items():
                if values.shape != (BRIEFED[name],) or not is_within(REMOTE_M, values):
                    raise ValueError(
                        f"{name} must be {BRIEFED[name]} numbers of magnitude up to {REMOTE_M:g}"
                    )
            return _at_flight_levels(Briefing(**arrays))
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise VehicleProcessError(
                f"{path.name}: the briefing cannot be read ({error})"
            ) from None

    def await_briefing(self, interrupts: Sequence[int]) -> Briefing:
        """Wait for the vehicle's first bytes, and return its briefing.

        Raises:
            VehicleProcessError: The vehicle has sent nothing in time, or has ended.
            Interrupted: The user interrupted the start.
        """
        deadline_s = time.monotonic() + _START_LIMIT_S
        while not select.select([self.link.fileno()], [], [], _LOOK_S)[0]:
            if interrupts:
                raise Interrupted("interrupted before the flight began")
            if time.monotonic() > deadline_s:
                raise VehicleProcessError(f"the vehicle sent nothing within {_START_LIMIT_S:g} s")
        try:
            return self.briefing()
        except VehicleProcessError:
            if failure := self.end():
                raise failure from None
            raise

    @abstractmethod
    def end(self) -> VehicleProcessError | None:
        """Close the link, end the vehicle, and set `truth`.

        Safe to call more than once.

        Returns:
            The error with which the vehicle ended, or None if it ended normally.
        """


class VehicleInProcess(Vehicle):
    """A vehicle in this process. It is simulated while the companion waits for it.

    Raises:
        MavfiError: The world, the vehicle, the start or the goal is invalid.
    """

    def __init__(self, config: MissionConfig) -> None:
        from sitl.options import VehicleSetup  # loads JSBSim
        from sitl.server import EmbeddedVehicle

        seed = Stream.SENSOR.seed(config.seed, "firmware")
        firmware = config.with_firmware().firmware
        setup = VehicleSetup(
            world=config.world,
            seed=config.seed_of_world,
            start_enu_m=config.start,
            goal_enu_m=config.goal,
            vehicle=config.vehicle,
            camera_size=(config.camera_columns, config.camera_rows),
            camera_rate_hz=config.camera_rate_hz,
            firmware_kind=None if config.autopilot == OWN_AUTOPILOT else config.autopilot,
            firmware=None if firmware is None else Path(firmware),
            firmware_seed=seed,
        )
        self._vehicle = EmbeddedVehicle(setup)
        self.link = self._vehicle.link

    @staticmethod
    def warm_up() -> None:
        """Load and compile all code that a vehicle in this process needs."""
        from sitl.server import warm_up

        warm_up()

    def briefing(self) -> Briefing:
        """Return the vehicle's briefing."""
        return _at_flight_levels(self._vehicle.briefing)

    def end(self) -> VehicleProcessError | None:
        """End the simulation and set `truth`. Return the error that ended the vehicle, if any."""
        self._vehicle.end()
        self.truth = self._vehicle.truth()
        error = self._vehicle.error
        if error is None:
            return None
        known = isinstance(error, MavfiError)
        why = str(error) if known else f"the vehicle ended with {described(error)}"
        return VehicleProcessError(why)


def _at_flight_levels(briefing: Briefing) -> Briefing:
    """Return a copy of the briefing with the flight levels as height bounds, not the world's."""
    bounds = briefing.bounds_enu_m.copy()
    bounds[2::3] = LOWEST_M, HIGHEST_M
    return replace(briefing, bounds_enu_m=bounds)


def _read_truth(folder: Path) -> FlightTruth | None:
    """Read the truth that a vehicle process has written. Return None if it has written none."""
    report, host = folder / "truth.json", folder / "host.json"
    if not report.is_file():
        return None
    with np.load(folder / "truth.npz") as data:
        log = {name: data[name] for name in data.files}
    times: Any = json.loads(host.read_text()) if host.is_file() else {}
    return FlightTruth(log=log, report=json.loads(report.read_text()), **times)


class VehicleProcess(Vehicle):
    """A vehicle in its own process, `python -m sitl`.

    The process ends when the link closes, and is killed when this process is.

    Raises:
        VehicleProcessError: The process cannot be started.
    """

    _name = "vehicle"

    def __init__(self, config: MissionConfig) -> None:
        self._scratch = ScratchFolder("flight")
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        line = [*PYTHON, "-m", *self._line(config, theirs.fileno())]
        self.depth = self._scratch.path / "depth"
        if config.companion is not None:
            companion = CompanionConfig.load(config.companion)
            line += ["--depth", str(self.depth)] if companion.uses("camera") else []
            line += [] if companion.key_file is None else ["--key-file", companion.key_file]
            line += [] if companion.camera_heartbeat else ["--camera-heartbeat", "0"]
        with theirs:
            try:
                self._process = subprocess.Popen(
                    [*line, "--truth", str(self._scratch.path)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=self._errors,
                    pass_fds=[theirs.fileno()],
                    start_new_session=True,  # Ctrl-C is for the companion, which then closes
                    # While its firmware boots, it does not see that the link has closed.
                    preexec_fn=partial(die_with, os.getpid()),
                )
            except OSError as error:
                ours.close()
                self._errors.close()
                self._scratch.close()
                raise VehicleProcessError(f"cannot start the {self._name}: {error}") from None
        self.link = open_transport(f"fd:{ours.detach()}")

    @staticmethod
    def _line(config: MissionConfig, descriptor: int) -> list[str]:
        """Return the module to run and its arguments, given the file descriptor of its link."""
        line = ["sitl", *_arguments(config)]
        if config.companion is not None:
            return [*line, "--link", f"onboard=fd:{descriptor}", "--speed", repr(config.speed)]
        line += ["--fd", str(descriptor)]
        if config.autopilot == OWN_AUTOPILOT:  # real firmware is paced by the wall clock alone
            line.append("--lockstep")
        return [*line, "--speed", "1"] if config.realtime else line

    def briefing(self) -> Briefing:
        """Return the briefing that the vehicle's process has written to a file."""
        return self.read_briefing(self._scratch.path / BRIEFING)

    def end(self) -> VehicleProcessError | None:
        """Close the link, wait for the process to end, and set `truth`. Return the error, if any.

        If the process does not end in time, kill it.
        """
        self.link.close()
        try:
            self._process.wait(_END_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._errors.closed:
            return None
        self.truth = _read_truth(self._scratch.path)
        self._scratch.close()
        with self._errors:
            return self._failure(self._process.returncode)

    def _failure(self, code: int) -> VehicleProcessError | None:
        if code == 0:
            return None
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        errors = [line for line in lines if line.startswith("error: ")]
        if errors:
            return VehicleProcessError(errors[-1].removeprefix("error: "), code)
        how = f"ended with code {code}"
        if code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
        last = f": {lines[-1]}" if lines else ""
        return VehicleProcessError(f"the {self._name} process {how}{last}")


class _LockstepProcess(VehicleProcess):
    """A vehicle in lockstep with a user's companion.

    The flight, not the vehicle, limits how long the companion may take to answer a tick.
    """

    @staticmethod
    def _line(config: MissionConfig, descriptor: int) -> list[str]:
        line = ["sitl", *_arguments(config), "--fd", str(descriptor), "--lockstep"]
        return [*line, "--answer-limit", "1e6"]


class _VehicleElsewhere(Vehicle):
    """A vehicle that another process has started. The arguments are those of `Vehicle.at`.

    Raises:
        LinkError: The link cannot be opened.
    """

    def __init__(self, url: str, briefing: Path) -> None:
        self._briefing = briefing
        self.link = open_transport(url)

    def briefing(self) -> Briefing:
        """Return the briefing that the other process has written to a file."""
        return self.read_briefing(self._briefing)

    def end(self) -> None:
        """Close the link. The other process sets no truth here."""
        self.link.close()


class _EyesProcess(VehicleProcess):
    """The process `python -m sitl.camera`: camera, referee and link for a foreign autopilot."""

    _name = "camera"

    def __init__(self, config: MissionConfig) -> None:
        super().__init__(config)
        select.select([self.link.fileno()], [], [], _START_LIMIT_S)  # its first bytes, or its end

    @staticmethod
    def _line(config: MissionConfig, descriptor: int) -> list[str]:
        assert config.link is not None
        line = ["sitl.camera", *_of_the_world(config, "--size", "--rate")]
        line += ["--link", config.link, "--link", f"fd:{descriptor}", *_place("origin", config)]
        return line if config.key_file is None else [*line, "--key-file", config.key_file]


def _arguments(config: MissionConfig) -> list[str]:
    """Return the arguments of `python -m sitl`, except those of the link and the truth's folder."""
    line = _of_the_world(config, "--camera-size", "--camera-rate")
    if config.autopilot != OWN_AUTOPILOT:
        line += ["--hil" if config.autopilot == "px4" else "--json", config.autopilot]
        line += ["--firmware", str(config.with_firmware().firmware), "--firmware-seed"]
        line.append(str(Stream.SENSOR.seed(config.seed, "firmware")))
    return line


def _of_the_world(config: MissionConfig, size: str, rate: str) -> list[str]:
    """Return the command-line options that describe the world, the vehicle and the camera."""
    return [
        "--world", config.world, "--seed", str(config.seed_of_world), "--vehicle", config.vehicle,
        size, f"{config.camera_columns}x{config.camera_rows}", rate, repr(config.camera_rate_hz),
        *_place("start", config), *_place("goal", config),
    ]  # fmt: skip


def _place(name: str, config: MissionConfig) -> list[str]:
    place = getattr(config, name)
    return [] if place is None else [f"--{name}={','.join(map(repr, place))}"]


StartVehicle = Callable[[MissionConfig], Vehicle]


@contextlib.contextmanager
def other_end(
    config: MissionConfig, launch: StartVehicle = Vehicle.start
) -> Iterator[tuple[Transport, Vehicle | None]]:
    """Connect to the mission's foreign autopilot, or start and connect to a simulated vehicle.

    Yield the link and the vehicle, which is None for a foreign autopilot without a camera process.
    At the end, close the link and end the vehicle.

    Raises:
        MavfiError: The link cannot be opened, or the vehicle cannot start.
    """
    if config.link is not None and not config.eyes:
        signing = signing_from_file(config.key_file)
        signed: Any = (
            {"signed": True, "admits": signing.authenticates} if signing is not None else {}
        )
        with contextlib.closing(open_transport(config.link, **signed)) as link:
            yield link, None
        return
    vehicle = (_EyesProcess if config.eyes else launch)(config)
    try:
        yield vehicle.link, vehicle
    finally:
        vehicle.end()
