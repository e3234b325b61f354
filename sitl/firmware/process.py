"""Starts the binary of a firmware in a folder of its own, and ends it."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.fork_server import die_with
from sitl.firmware.px4 import PORT
from sitl.firmware.tuning import Parameters
from sitl.geodesy import Origin

_LOOPBACK = "127.0.0.1"
_OUTPUT = "output.txt"
_PX4_LOCAL_PORT = 14580
_PX4_SOCKET = "/tmp/px4-sock-{}"  # on which a running instance serves its commands
_EPOCH_S = 1_600_000_000  # start of ArduPilot's clock: the same in every flight

# PX4 sources these scripts instead of its own: the parameters of the vehicle before its modules
# start, and one link to a companion without others.
_PX4_SIMULATOR = """#!/bin/sh
{settings}
simulator_mavlink start -c {port}
"""
_PX4_LINKS = """#!/bin/sh
mavlink start -x -u {local} -r 4000000 -f -m onboard -o {remote}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class FirmwareOrder:
    """What a firmware is started with."""

    binary: Path
    parameters: Parameters  # those of the vehicle, set before it starts
    system_id: int  # MAVLink system id, which PX4 is told
    simulator_port: int  # of the simulator link; PX4's own and the instance number, or ArduPilot's
    remote_port: int  # UDP port to which it sends MAVLink
    origin: Origin  # geographic origin of the world
    heading_deg: float  # at the start


class FirmwareProcess:
    """A running firmware. Its folder and everything that it started end with it.

    Args:
        binary: The program.
        arguments: Command line after the program.
        folder: Working folder, removed at the end.
        environment: Additions to the environment.

    Raises:
        VehicleProcessError: The program cannot be started.
    """

    def __init__(
        self,
        binary: Path,
        arguments: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
    ) -> None:
        self._binary, self._folder = binary, folder
        try:
            with (folder / _OUTPUT).open("wb") as output:
                self._process = subprocess.Popen(
                    [str(binary), *arguments],
                    cwd=folder,
                    env={**os.environ, **environment},
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=functools.partial(die_with, os.getpid()),
                )
        except OSError as error:
            self._remove_folder()
            raise VehicleProcessError(f"{binary} is no firmware: {error.strerror}") from None

    def require_running(self) -> None:
        """Check that it still runs.

        Raises:
            VehicleProcessError: It has ended; quotes its last line.
        """
        code = self._process.poll()
        if code is None:
            return
        lines = (self._folder / _OUTPUT).read_text(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        last = f": {said[-1]}" if said else ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        raise VehicleProcessError(f"the firmware {self._binary} {how}{last}")

    def end(self) -> None:
        """Kill it with all of its children and remove its folder. May be called repeatedly."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._remove_folder()

    def _remove_folder(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


def _require_program(path: Path) -> Path:
    """Return the absolute path of a program.

    Raises:
        VehicleProcessError: It does not exist or must not be executed.
    """
    if not path.is_file():
        raise VehicleProcessError(f"no firmware at {path}")
    if not os.access(path, os.X_OK):
        raise VehicleProcessError(f"no permission to execute {path}")
    return path.resolve()


def px4_is_running(instance: int) -> bool:
    """Return True if a PX4 of this number runs on this machine. It would not start a second."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        return probe.connect_ex(_PX4_SOCKET.format(instance)) == 0


def start_px4(order: FirmwareOrder) -> FirmwareProcess:
    """Start PX4's SITL binary, which lies in `bin/` beside its startup files in `etc/`.

    Raises:
        VehicleProcessError: It cannot be started.
    """
    program = _require_program(order.binary)
    startup = program.parent.parent / "etc"
    if not (startup / "init.d-posix" / "rcS").is_file():
        raise VehicleProcessError(f"{order.binary} is no PX4: it has no startup files in {startup}")
    folder = Path(tempfile.mkdtemp(prefix="mavfi-px4-"))
    instance = order.simulator_port - PORT
    settings = [
        f"param set {name} {value:.6g}"
        for name, value in {**order.parameters, "MAV_SYS_ID": order.system_id}.items()
    ]
    simulator = _PX4_SIMULATOR.format(settings="\n".join(settings), port=order.simulator_port)
    (folder / "px4-rc.simulator").write_text(simulator)
    links = _PX4_LINKS.format(local=_PX4_LOCAL_PORT + instance, remote=order.remote_port)
    (folder / "px4-rc.mavlink").write_text(links)
    environment = {
        "PX4_SIM_MODEL": "none_iris",
        "PATH": f"{folder}:{program.parent}:{os.environ.get('PATH', '')}",
    }
    arguments = ["-d", "-i", str(instance), "-w", str(folder), str(startup)]
    return FirmwareProcess(program, arguments, folder, environment)


def start_ardupilot(order: FirmwareOrder) -> FirmwareProcess:
    """Start ArduCopter's SITL binary.

    Raises:
        VehicleProcessError: It cannot be started.
    """
    program, origin = _require_program(order.binary), order.origin
    folder = Path(tempfile.mkdtemp(prefix="mavfi-ardupilot-"))
    lines = [f"{name} {value:.6g}" for name, value in order.parameters.items()]
    (folder / "vehicle.parm").write_text("\n".join(lines) + "\n")
    home = (origin.latitude_deg, origin.longitude_deg, origin.altitude_amsl_m, order.heading_deg)
    arguments = [
        "--model", f"JSON:{_LOOPBACK}", "--wipe", "--speedup", "100",
        "--defaults", "vehicle.parm",
        "--home", ",".join(f"{value:.7f}" for value in home),
        "--start-time", str(_EPOCH_S),
        "--sim-port-out", str(order.simulator_port), "--sim-port-in", "0", "--rc-in-port", "0",
        "--serial0", f"udpclient:{_LOOPBACK}:{order.remote_port}", "--serial1", "none:",
        "--serial2", "none:",
    ]  # fmt: skip
    return FirmwareProcess(program, arguments, folder, {})
