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

from mavfi_cli.core.errors import EndpointError, MavfiError, VehicleProcessError
from mavfi_cli.core.frames import Vector
from mavfi_cli.link.transport import Transport, open_transport
from sitl.firmware import ardupilot, px4
from sitl.firmware.ardupilot import ArduPilotLink
from sitl.firmware.autopilot import FirmwareAutopilot
from sitl.firmware.process import (
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


class SimulatorLink(Protocol):
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
    link: SimulatorLink
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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Order:
    """What a firmware and its simulator link are made from."""

    binary: Path | None
    parameters: Parameters
    sensors: Sensors
    system_id: int
    remote_port: int
    heading_deg: float


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
    mavlink = open_transport(url if binary is None else "udpin:127.0.0.1:0")
    is_px4 = kind is FirmwareKind.PX4
    to_goal = world.goal_enu_m - world.start_enu_m
    order = _Order(
        binary=binary,
        parameters=PARAMETERS[kind](profile),
        sensors=Sensors(seed),
        system_id=system_id,
        remote_port=0 if binary is None else int(mavlink.port),  # type: ignore[attr-defined]
        heading_deg=math.degrees(math.atan2(to_goal[0], to_goal[1])) % 360.0,
    )
    try:
        link, process = (_open_px4 if is_px4 else _open_ardupilot)(order)
    except MavfiError:
        mavlink.close()
        raise
    autopilot = FirmwareAutopilot(mavlink, Origin(), system_id=system_id, echoes=is_px4)
    return Firmware(autopilot=autopilot, link=link, process=process)


_Opened = tuple[SimulatorLink, FirmwareProcess | None]


def _open_px4(order: _Order) -> _Opened:
    server, port = _px4_server(1 if order.binary is None else _INSTANCES)
    link = Px4Link(server, order.sensors)
    if order.binary is None:
        return link, None
    try:
        return link, start_px4(
            order.binary, order.parameters, simulator_port=port,
            remote_port=order.remote_port, system_id=order.system_id,
        )  # fmt: skip
    except MavfiError:
        link.close()
        raise


def _px4_server(tries: int) -> tuple[Transport, int]:
    """Open the first free port of PX4's instances, and return it with its number.

    Args:
        tries: Number of instances to try. More than one is for a PX4 that will be started.

    Raises:
        EndpointError: All of them are in use.
    """
    for port in range(px4.PORT, px4.PORT + tries - 1):
        if px4_is_running(port - px4.PORT):
            continue
        with contextlib.suppress(EndpointError):
            return open_transport(f"tcpin:127.0.0.1:{port}"), port
    last = px4.PORT + tries - 1
    return open_transport(f"tcpin:127.0.0.1:{last}"), last


def _open_ardupilot(order: _Order) -> _Opened:
    link = ArduPilotLink(order.sensors, ardupilot.PORT if order.binary is None else 0)
    if order.binary is None:
        return link, None
    try:
        return link, start_ardupilot(
            order.binary, order.parameters, simulator_port=link.port,
            remote_port=order.remote_port, origin=Origin(), heading_deg=order.heading_deg,
        )  # fmt: skip
    except MavfiError:
        link.close()
        raise
