"""Puts a firmware and its links together: what `--hil px4` and `--json ardupilot` start."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Protocol

from mavfi_cli.core.errors import EndpointError, VehicleProcessError
from mavfi_cli.core.frames import Vector
from mavfi_cli.link.transport import open_transport
from sitl.firmware import ardupilot, px4
from sitl.firmware.ardupilot import ArduPilotLink
from sitl.firmware.autopilot import FirmwareAutopilot
from sitl.firmware.process import (
    FirmwareOrder,
    FirmwareProcess,
    px4_is_running,
    start_ardupilot,
    start_px4,
)
from sitl.firmware.px4 import Px4Link
from sitl.firmware.sensors import Sensors
from sitl.firmware.tuning import Parameters, ardupilot_parameters, px4_parameters
from sitl.geodesy import Origin
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.vehicle import Truth
from sitl.world import World

LINK = "udpin:127.0.0.1:14540"
"""Where a firmware that somebody else starts sends its MAVLink."""

_INSTANCES = 100  # of PX4 on one machine
_START_LIMIT_S, _LOOK_S = 60.0, 0.2


class FirmwareKind(Enum):
    """A firmware with a simulator link."""

    PX4 = "px4"
    ARDUPILOT = "ardupilot"


class _SimulatorLink(Protocol):
    """The link over which a firmware gets its sensors and gives its motor outputs."""

    @property
    def step_s(self) -> float:
        """Physics step that the firmware needs, s."""

    @property
    def settle_s(self) -> float:
        """Simulated time on the ground before the first client is served, s."""

    def heard(self, timeout_s: float) -> bool:
        """Return True once the firmware has called, waiting at most `timeout_s`."""

    def exchange(self, stamp_us: int, truth: Truth) -> Vector:
        """Send the state at a stamp and return the motor outputs (4,) in 0..1."""

    def close(self) -> None:
        """Close the link."""


PARAMETERS: dict[FirmwareKind, Callable[[VehicleProfile], Parameters]] = {
    FirmwareKind.PX4: px4_parameters,
    FirmwareKind.ARDUPILOT: ardupilot_parameters,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Firmware:
    """A firmware with its links, and its process if we started it."""

    autopilot: FirmwareAutopilot
    link: _SimulatorLink
    process: FirmwareProcess | None

    def wait(self, stopped: Callable[[], bool]) -> None:
        """Wait until the firmware calls, or until stopped.

        Raises:
            VehicleProcessError: We started it, and it has ended or did not call within a minute.
        """
        deadline_s = time.monotonic() + _START_LIMIT_S
        while not stopped() and not self.link.heard(_LOOK_S):
            if self.process is None:
                continue
            self.process.require_running()
            if time.monotonic() > deadline_s:
                raise VehicleProcessError(f"no firmware called within {_START_LIMIT_S:g} s")

    def close(self) -> None:
        """End the process and close the links."""
        if self.process is not None:
            self.process.end()
        self.autopilot.close()
        self.link.close()


def open_firmware(
    kind: FirmwareKind,
    binary: Path | None,
    world: World,
    profile: VehicleProfile,
    *,
    seed: int,
    system_id: int,
    url: str,
) -> Firmware:
    """Open the links of a firmware, and start it if a binary is given.

    Args:
        kind: Which firmware.
        binary: Its SITL program; None if somebody else starts it.
        world: World of the flight.
        profile: Profile of the vehicle.
        seed: Seed of the sensors' noise.
        system_id: MAVLink system id of the firmware.
        url: Link on which a firmware that somebody else starts sends its MAVLink.

    Raises:
        EndpointError: A port is in use.
        VehicleProcessError: The binary cannot be started.
    """
    sensors, to_goal = Sensors(seed), world.goal_enu_m - world.start_enu_m
    with contextlib.ExitStack() as undo:
        mavlink = open_transport(url if binary is None else "udpin:127.0.0.1:0")
        undo.callback(mavlink.close)
        is_px4, ours = kind is FirmwareKind.PX4, binary is not None
        link, port = (_px4_link if is_px4 else _ardupilot_link)(sensors, ours=ours)
        undo.callback(link.close)
        process = None
        if binary is not None:
            order = FirmwareOrder(
                binary=binary,
                parameters=PARAMETERS[kind](profile),
                system_id=system_id,
                simulator_port=port,
                remote_port=int(mavlink.port),  # type: ignore[attr-defined]
                origin=Origin(),
                heading_deg=math.degrees(math.atan2(to_goal[0], to_goal[1])) % 360.0,
            )
            process = (start_px4 if is_px4 else start_ardupilot)(order)
        undo.pop_all()
    autopilot = FirmwareAutopilot(mavlink, Origin(), system_id=system_id, echoes=is_px4)
    return Firmware(autopilot=autopilot, link=link, process=process)


def _px4_link(sensors: Sensors, *, ours: bool) -> tuple[_SimulatorLink, int]:
    """Open the first free port of PX4's instances, of the first one unless we start it.

    Raises:
        EndpointError: All of them are in use.
    """
    ports = range(px4.PORT, px4.PORT + (_INSTANCES if ours else 1))
    for port in ports[:-1]:
        if px4_is_running(port - px4.PORT):
            continue
        with contextlib.suppress(EndpointError):
            return Px4Link(open_transport(f"tcpin:127.0.0.1:{port}"), sensors), port
    return Px4Link(open_transport(f"tcpin:127.0.0.1:{ports[-1]}"), sensors), ports[-1]


def _ardupilot_link(sensors: Sensors, *, ours: bool) -> tuple[_SimulatorLink, int]:
    """Open ArduPilot's port, or any if we start it."""
    link = ArduPilotLink(sensors, 0 if ours else ardupilot.PORT)
    return link, link.port
