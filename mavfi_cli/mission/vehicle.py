"""The simulated vehicle of a mission: in the mission's own process, or beside it in another.

Either way companion and vehicle share the bytes of a MAVLink link, and the folder in which the
vehicle leaves its briefing before its first message and, at the end, the referee's truth. This is
the only module of the companion's side that imports the vehicle's, and only to start it.
"""

from __future__ import annotations

import contextlib
import json
import select
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.errors import MavfiError, VehicleProcessError, described
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.processes import PYTHON
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import Briefing, FloatArray
from mavfi_cli.link.codec import Signing, key_from_file
from mavfi_cli.link.transport import Transport, open_transport
from mavfi_cli.spec.mission import HIGHEST_M, LOWEST_M, OWN_AUTOPILOT, MissionConfig

_START_LIMIT_S = 120.0  # of a camera; its first start compiles
_END_LIMIT_S = 20.0


class Vehicle:
    """A simulated vehicle: the link to it, and the folder in which it leaves its files."""

    link: Transport

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @staticmethod
    def start(config: MissionConfig, folder: Path) -> Vehicle:
        """Start the vehicle in this process, or beside it where both run by the wall clock."""
        return (VehicleProcess if config.realtime else VehicleInProcess)(config, folder)

    def end(self) -> VehicleProcessError | None:
        """Close the link and save the truth; return why the vehicle ended before that, if it did.

        Raises:
            RecordError: the truth cannot be saved.
        """
        raise NotImplementedError

    def briefing(self) -> Briefing:
        """Read start, goal, bounds and camera, which only the vehicle knows, as it has the world.

        Raises:
            VehicleProcessError: There is no briefing.
        """
        try:
            data = json.loads((self._folder / "briefing.json").read_text())
            data["bounds_enu_m"][2::3] = LOWEST_M, HIGHEST_M
            told: Any = {name: np.array(values, np.float64) for name, values in data.items()}
            return Briefing(**told)
        except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
            raise VehicleProcessError(f"the vehicle process left no briefing ({error})") from None

    def report(self, name: str) -> dict[str, Any] | None:
        """Read a JSON file that the vehicle has left; None if it has not."""
        path = self._folder / f"{name}.json"
        told: dict[str, Any] | None = json.loads(path.read_text()) if path.is_file() else None
        return told

    def truth(self) -> dict[str, FloatArray] | None:
        """Read the referee's log by column; None if the vehicle died before it was saved."""
        if self.report("truth") is None:
            return None
        with np.load(self._folder / "truth.npz") as data:
            return {name: data[name] for name in data.files}


class VehicleInProcess(Vehicle):
    """The vehicle in this process; it flies while the companion waits for it.

    Args:
        folder: where the vehicle leaves its files.

    Raises:
        MavfiError: the world, the vehicle, the start or the goal cannot be used.
    """

    def __init__(self, config: MissionConfig, folder: Path) -> None:
        from sitl.server import embedded

        super().__init__(folder)
        self._vehicle = embedded(_arguments(config), folder)
        self.link = self._vehicle.link

    @staticmethod
    def warm_up() -> None:
        """Load and compile all that a vehicle in this process needs."""
        from sitl.server import warm_up

        warm_up()

    def end(self) -> VehicleProcessError | None:
        """See `Vehicle`."""
        self._vehicle.end()
        error = self._vehicle.error
        if error is None:
            return None
        known = isinstance(error, MavfiError)
        why = str(error) if known else f"the vehicle ended with {described(error)}"
        return VehicleProcessError(why)


class VehicleProcess(Vehicle):
    """`python -m sitl` in lockstep, as `VehicleInProcess`. Closing the socket ends it.

    Raises:
        VehicleProcessError: it cannot be started.
    """

    _name = "vehicle"

    def __init__(self, config: MissionConfig, folder: Path) -> None:
        super().__init__(folder)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        line = [*PYTHON, "-m", *self._line(config, theirs.fileno())]
        with theirs:
            try:
                self._process = subprocess.Popen(
                    [*line, "--truth", str(folder)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=self._errors,
                    pass_fds=[theirs.fileno()],
                    start_new_session=True,  # Ctrl-C is for the companion, which then closes
                )
            except OSError as error:
                ours.close()
                self._errors.close()
                raise VehicleProcessError(f"cannot start the {self._name}: {error}") from None
        self.link = open_transport(f"fd:{ours.detach()}")

    @staticmethod
    def _line(config: MissionConfig, descriptor: int) -> list[str]:
        """Return module and arguments of the process, which speaks on the descriptor."""
        line = ["sitl", *_arguments(config), "--fd", str(descriptor)]
        if config.autopilot == OWN_AUTOPILOT:  # real firmware is paced by the wall clock alone
            line.append("--lockstep")
        return [*line, "--speed", "1"] if config.realtime else line

    def end(self) -> VehicleProcessError | None:
        """See `Vehicle`; a vehicle that does not end is killed."""
        self.link.close()
        try:
            self._process.wait(_END_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._errors.closed:
            return None
        with self._errors:
            return self._failure(self._process.returncode)

    def _failure(self, code: int) -> VehicleProcessError | None:
        if code == 0:
            return None
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        told = [line for line in lines if line.startswith("error: ")]
        if told:
            return VehicleProcessError(told[-1].removeprefix("error: "), code)
        how = f"ended with code {code}"
        if code < 0:
            how = f"was killed by {signal.Signals(-code).name}"
        last = f": {lines[-1]}" if lines else ""
        return VehicleProcessError(f"the {self._name} process {how}{last}")


class _EyesProcess(VehicleProcess):
    """`python -m sitl.camera`: camera and referee of a foreign autopilot, and the link to it."""

    _name = "camera"

    def __init__(self, config: MissionConfig, folder: Path) -> None:
        super().__init__(config, folder)
        select.select([self.link.fileno()], [], [], _START_LIMIT_S)  # its first word, or its end

    @staticmethod
    def _line(config: MissionConfig, descriptor: int) -> list[str]:
        assert config.link is not None
        line = ["sitl.camera", *_of_the_world(config, "--size", "--rate")]
        line += ["--link", config.link, "--link", f"fd:{descriptor}", *_place("origin", config)]
        return line if config.key_file is None else [*line, "--key-file", config.key_file]


def _arguments(config: MissionConfig) -> list[str]:
    """Return the arguments of `python -m sitl`, but for the link and the folder of the truth."""
    line = _of_the_world(config, "--camera-size", "--camera-rate")
    if config.autopilot != OWN_AUTOPILOT:
        line += ["--hil" if config.autopilot == "px4" else "--json", config.autopilot]
        line += ["--firmware", str(config.with_firmware().firmware), "--firmware-seed"]
        line.append(str(Stream.SENSOR.seed(config.seed, "firmware")))
    return line


def _of_the_world(config: MissionConfig, size: str, rate: str) -> list[str]:
    """Return the options of world, vehicle and camera; those of the camera have other names."""
    return [
        "--world", config.world, "--seed", str(config.seed_of_world), "--vehicle", config.vehicle,
        size, f"{config.camera_columns}x{config.camera_rows}", rate, f"{config.camera_rate_hz:g}",
        *_place("start", config), *_place("goal", config),
    ]  # fmt: skip


def _place(name: str, config: MissionConfig) -> list[str]:
    place = getattr(config, name)
    return [] if place is None else [f"--{name}={','.join(f'{value:.9g}' for value in place)}"]


StartVehicle = Callable[[MissionConfig, Path], Vehicle]


def signing_of(config: MissionConfig) -> Signing | None:
    """Return the signing of a mission's link.

    Raises:
        ConfigError: The key file cannot be read.
    """
    if config.key_file is None:
        return None
    return Signing(key_from_file(Path(config.key_file)), clock=time.time)


@contextlib.contextmanager
def other_end(
    config: MissionConfig, launch: StartVehicle = Vehicle.start
) -> Iterator[tuple[Transport, Vehicle | None]]:
    """Connect to a mission's foreign autopilot, or else to a simulated vehicle that starts.

    Raises:
        MavfiError: the link cannot be opened, or the vehicle cannot start.
    """
    if config.link is not None and not config.eyes:
        signing = signing_of(config)
        signed: Any = {"signed": True, "admits": signing.vouches} if signing is not None else {}
        with contextlib.closing(open_transport(config.link, **signed)) as link:
            yield link, None
        return
    with contextlib.ExitStack() as leaving:
        folder = leaving.enter_context(ScratchFolder("flight"))
        vehicle = (_EyesProcess if config.eyes else launch)(config, folder)
        leaving.callback(vehicle.end)
        yield vehicle.link, vehicle
