"""The simulated vehicle as a child process that speaks MAVLink over an inherited socket pair."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import tempfile
from copy import copy
from pathlib import Path

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.vehicle_template import ForkedVehicle, VehicleTemplate

_FOR_EVER_S = "1e9"


class VehicleProcess:
    """`python -m sitl` in lockstep. Closing the socket ends it and saves the referee's truth.

    Args:
        config: the mission.
        truth_folder: where the vehicle leaves briefing and truth.
        template: forks the vehicle; None: it is started as a program.
        patient: the companion may take as long as it likes to answer.
    """

    def __init__(
        self,
        config: MissionConfig,
        truth_folder: Path,
        template: VehicleTemplate | None = None,
        *,
        patient: bool = False,
    ) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        arguments = _arguments(config, truth_folder)
        if patient:
            arguments += ["--answer-limit", _FOR_EVER_S]
        self._process: subprocess.Popen[bytes] | ForkedVehicle
        with theirs:
            try:
                if template is None:
                    self._process = self._started(arguments, theirs)
                else:
                    self._process = template.start(arguments, theirs, self._errors.fileno())
            except (OSError, VehicleProcessError) as error:
                ours.close()
                self._errors.close()
                if isinstance(error, VehicleProcessError):
                    raise
                raise VehicleProcessError(f"cannot start the vehicle: {error}") from None
        self._socket = ours

    def _started(self, arguments: list[str], link: socket.socket) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "sitl", *arguments, "--fd", str(link.fileno())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            pass_fds=[link.fileno()],
            start_new_session=True,  # Ctrl-C is for the companion, which then closes
        )

    def branch(self, truth_folder: Path) -> VehicleProcess:
        """The vehicle once more, as it is while it waits for an answer; a fork of a template only.

        Raises:
            VehicleProcessError: it does not branch.
        """
        assert isinstance(self._process, ForkedVehicle)
        twin = copy(self)
        twin._errors = tempfile.TemporaryFile()  # noqa: SIM115 - as above
        twin._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs:
            try:
                twin._process = self._process.branch(truth_folder, theirs, twin._errors.fileno())
            except VehicleProcessError:
                twin._socket.close()
                twin._errors.close()
                raise
        return twin

    def detach(self) -> int:
        """Our end of the socket pair; the caller closes it."""
        return self._socket.detach()

    def stop(self, timeout_s: float = 20.0) -> None:
        """After our end was closed: let it save the truth and end; kill it where it does not."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def close(self) -> None:
        """Forget what it said; after `stop`."""
        self._errors.close()
        if isinstance(self._process, ForkedVehicle):
            self._process.close()

    def failure(self) -> VehicleProcessError | None:
        """What it said when it ended with an error; None where it ended well."""
        code = self._process.poll()
        if code is None or code == 0:
            return None
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        told = [line for line in lines if line.startswith("error: ")]
        if told:
            return VehicleProcessError(told[-1].removeprefix("error: "))
        killed = code < 0
        how = f"was killed by {signal.Signals(-code).name}" if killed else f"ended with code {code}"
        last = f": {lines[-1]}" if lines else ""
        return VehicleProcessError(f"the vehicle process {how}{last}")


def _arguments(config: MissionConfig, truth_folder: Path) -> list[str]:
    line = [
        "--lockstep",
        "--world", config.world, "--seed", str(config.seed_of_world), "--vehicle", config.vehicle,
        "--camera-size", f"{config.camera_columns}x{config.camera_rows}",
        "--camera-rate", f"{config.camera_rate_hz:g}",
        "--truth", str(truth_folder),
    ]  # fmt: skip
    for name, place in (("--start", config.start), ("--goal", config.goal)):
        if place is not None:
            line.append(f"{name}={','.join(f'{value:.9g}' for value in place)}")
    if config.realtime:
        line += ["--speed", "1"]
    return line
