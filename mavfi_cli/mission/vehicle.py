"""The simulated vehicle of a mission: in the mission's own process, or beside it in another.

Either way companion and vehicle share the bytes of a MAVLink link, and the folder in which the
vehicle leaves its briefing and, at the end, the referee's truth. This is the only module of the
companion's side that imports the vehicle's, and only to start it.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from mavfi_cli.core.errors import ConfigError, MavfiError, VehicleProcessError, described
from mavfi_cli.core.processes import PYTHON
from mavfi_cli.core.seeds import Stream, derive
from mavfi_cli.link.codec import Signing, key_from_file
from mavfi_cli.link.transport import Transport, open_transport
from mavfi_cli.spec.mission import FIRMWARE, OWN_AUTOPILOT, MissionConfig

START_LIMIT_S = 120.0  # of a camera; its first start compiles


class VehicleInProcess:
    """The vehicle in this process; it flies while the companion waits for it.

    Args:
        folder: where the vehicle leaves briefing and truth.

    Raises:
        MavfiError: the world, the vehicle, the start or the goal cannot be used.
    """

    def __init__(self, config: MissionConfig, folder: Path) -> None:
        from sitl.server.main import embedded

        self.folder = folder
        self._vehicle = embedded(_arguments(config), folder)
        self.link: Transport = self._vehicle.link

    def end(self) -> VehicleProcessError | None:
        """Close the link and save the truth; return why the vehicle ended before that, if it did.

        Raises:
            RecordError: the truth cannot be saved.
        """
        self._vehicle.end()
        error = self._vehicle.error
        if error is None:
            return None
        known = isinstance(error, MavfiError)
        return VehicleProcessError(
            str(error) if known else f"the vehicle ended with {described(error)}"
        )


def warm_up() -> None:
    """Load and compile all that a vehicle in this process needs."""
    from sitl.server.main import warm_up

    warm_up()


class VehicleProcess:
    """`python -m sitl` in lockstep, as `VehicleInProcess`. Closing the socket ends it.

    Raises:
        VehicleProcessError: it cannot be started.
    """

    _name = "vehicle"

    def __init__(self, config: MissionConfig, folder: Path) -> None:
        self.folder = folder
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
        self.link: Transport = open_transport(f"fd:{ours.detach()}")

    @staticmethod
    def _line(config: MissionConfig, descriptor: int) -> list[str]:
        """Return module and arguments of the process, which speaks on the descriptor."""
        line = ["sitl", *_arguments(config), "--fd", str(descriptor)]
        if config.autopilot == OWN_AUTOPILOT:  # real firmware is paced by the wall clock alone
            line.append("--lockstep")
        return [*line, "--speed", "1"] if config.realtime else line

    def end(self, timeout_s: float = 20.0) -> VehicleProcessError | None:
        """See `VehicleInProcess`; a vehicle that does not end is killed."""
        self.link.close()
        try:
            self._process.wait(timeout_s)
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
        killed = code < 0
        how = f"was killed by {signal.Signals(-code).name}" if killed else f"ended with code {code}"
        last = f": {lines[-1]}" if lines else ""
        return VehicleProcessError(f"the {self._name} process {how}{last}")


class _EyesProcess(VehicleProcess):
    """`python -m sitl.camera`: camera and referee of a foreign autopilot, and the link to it."""

    _name = "camera"

    def __init__(self, config: MissionConfig, folder: Path) -> None:
        super().__init__(config, folder)
        select.select([self.link.fileno()], [], [], START_LIMIT_S)  # its first word, or its end

    @staticmethod
    def _line(config: MissionConfig, descriptor: int) -> list[str]:
        assert config.link is not None
        line = ["sitl.camera", *_of_the_world(config, "--size", "--rate")]
        line += ["--link", config.link, "--link", f"fd:{descriptor}", *_place("origin", config)]
        return line if config.key_file is None else [*line, "--key-file", config.key_file]


def _arguments(config: MissionConfig) -> list[str]:
    """Return the arguments of `python -m sitl`, but for the link and the folder of the truth."""
    return _of_the_world(config, "--camera-size", "--camera-rate") + _firmware_arguments(config)


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


def _firmware_arguments(config: MissionConfig) -> list[str]:
    """Options that let a real autopilot fly; none for our own."""
    if config.autopilot == OWN_AUTOPILOT:
        return []
    option = "--hil" if config.autopilot == "px4" else "--json"
    seed = derive(config.seed, Stream.SENSOR, "firmware")
    return [
        option, config.autopilot, "--firmware", str(with_firmware(config).firmware),
        "--firmware-seed", str(seed),
    ]  # fmt: skip


def with_firmware(config: MissionConfig) -> MissionConfig:
    """Return the mission with the SITL binary of its real autopilot, so that a record names it.

    Raises:
        ConfigError: Neither the mission nor the environment names one.
    """
    if config.autopilot == OWN_AUTOPILOT:
        return config
    variable = FIRMWARE[config.autopilot]
    path = config.firmware or os.environ.get(variable)
    if not path:
        raise ConfigError(
            f"{config.autopilot} needs its SITL binary: --firmware PATH, or {variable} in the "
            "environment",
            key="firmware",
        )
    return replace(config, firmware=path)


Vehicle = VehicleInProcess | VehicleProcess
StartVehicle = Callable[[MissionConfig, Path], Vehicle]


def start_vehicle(config: MissionConfig, folder: Path) -> Vehicle:
    """Start the vehicle in this process, or beside it where both run by the wall clock."""
    start = VehicleProcess if config.realtime else VehicleInProcess
    return start(config, folder)


def signing_of(config: MissionConfig) -> Signing | None:
    """Return the signing of a mission's link.

    Raises:
        ConfigError: The key file cannot be read.
    """
    if config.key_file is None:
        return None
    return Signing(key_from_file(Path(config.key_file)), clock=time.time)


def _foreign_link(url: str, signing: Signing | None) -> Transport:
    if signing is None:
        return open_transport(url)
    return open_transport(url, signed=True, admits=signing.vouches)


@contextlib.contextmanager
def other_end(
    config: MissionConfig, launch: StartVehicle = start_vehicle
) -> Iterator[tuple[Transport, Vehicle | None]]:
    """Connect to a mission's foreign autopilot, or else to a simulated vehicle that starts.

    Raises:
        MavfiError: the link cannot be opened, or the vehicle cannot start.
    """
    if config.link is not None and not config.eyes:
        with contextlib.closing(_foreign_link(config.link, signing_of(config))) as link:
            yield link, None
        return
    folder = Path(tempfile.mkdtemp(prefix="mavfi-"))
    with contextlib.ExitStack() as leaving:
        leaving.callback(shutil.rmtree, folder, ignore_errors=True)
        vehicle = (_EyesProcess if config.eyes else launch)(config, folder)
        leaving.callback(vehicle.end)
        yield vehicle.link, vehicle
