"""Common form of COMMAND_LONG and COMMAND_INT, and execution of each command."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import Result
from sitl.autopilot.link import Link
from sitl.autopilot.modes import FlightMode, mode_from_numbers
from sitl.autopilot.snapshot import int32
from sitl.autopilot.streams import BUILDERS
from sitl.autopilot.text import Severity

if TYPE_CHECKING:
    from sitl.autopilot.autopilot import Autopilot

_FORCE_MAGIC = 21196
_INT_UNSET = 0x7FFFFFFF
_RELATIVE_FRAMES = (3, 6, 10, 11)
_FARTHEST_M = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleCommand:
    """A command from either message. Missing parameters are NaN."""

    number: int
    p1: float
    p2: float
    p3: float
    p4: float
    latitude_deg: float  # p5 of a COMMAND_LONG
    longitude_deg: float  # p6
    altitude_m: float  # p7
    above_home: bool  # altitude above home; otherwise above sea level
    system: int  # system id of the sender
    component: int


def from_long(message: Any) -> VehicleCommand:
    """Convert a COMMAND_LONG to the common form."""
    return VehicleCommand(
        number=message.command, p1=message.param1, p2=message.param2, p3=message.param3,
        p4=message.param4, latitude_deg=message.param5, longitude_deg=message.param6,
        altitude_m=message.param7, above_home=False,
        system=message.get_srcSystem(), component=message.get_srcComponent(),
    )  # fmt: skip


def from_int(message: Any) -> VehicleCommand:
    """Convert a COMMAND_INT to the common form."""
    return VehicleCommand(
        number=message.command, p1=message.param1, p2=message.param2, p3=message.param3,
        p4=message.param4, latitude_deg=_degrees(message.x), longitude_deg=_degrees(message.y),
        altitude_m=message.z, above_home=message.frame in _RELATIVE_FRAMES,
        system=message.get_srcSystem(), component=message.get_srcComponent(),
    )  # fmt: skip


def _degrees(value: int) -> float:
    return math.nan if value == _INT_UNSET else value * 1e-7


def acknowledge(command: VehicleCommand, result: Result) -> Any:
    """Return the COMMAND_ACK to the sender."""
    return dialect.MAVLink_command_ack_message(
        command.number, int(result), 0, 0, command.system, command.component
    )


def _whole(value: float) -> int | None:
    """Return an integer parameter; None if it is not an integer."""
    return int(value) if math.isfinite(value) and value == int(value) else None


def execute(autopilot: Autopilot, command: VehicleCommand, link: Link) -> None:
    """Execute a command and acknowledge it."""
    handler = _HANDLERS.get(command.number)
    result = Result.UNSUPPORTED if handler is None else handler(autopilot, command, link)
    if result is not None:
        link.send(acknowledge(command, result))


def _arm_disarm(autopilot: Autopilot, command: VehicleCommand, _link: Link) -> Result | None:
    force = _whole(command.p2) == _FORCE_MAGIC
    if command.p1 == 1.0:
        return autopilot.commander.request_arm(force=force)
    if command.p1 == 0.0:
        return autopilot.commander.request_disarm(force=force)
    autopilot.commander.say(Severity.CRITICAL, "Unsupported ARM_DISARM param")
    return None


def _set_mode(autopilot: Autopilot, command: VehicleCommand, link: Link) -> Result:
    """Answer twice like PX4: its receiver acknowledges first, then its commander decides."""
    link.send(acknowledge(command, Result.ACCEPTED))
    base, main, sub = (_whole(value) for value in (command.p1, command.p2, command.p3))
    if base is None or not base & 1 or main is None:
        return Result.TEMPORARILY_REJECTED
    return autopilot.enter_mode(mode_from_numbers(main, sub or 0))


def _takeoff(autopilot: Autopilot, command: VehicleCommand, _link: Link) -> Result:
    height = autopilot.parameters.effective("MIS_TAKEOFF_ALT")
    home_down = float(autopilot.snapshot.home_ned_m[2])
    target = home_down - height
    down = _down(autopilot, command)
    say = autopilot.commander.say
    if math.isnan(down):
        say(Severity.INFO, f"Using default takeoff altitude: {height:.1f} m")
    elif down > target + 0.1:
        say(Severity.CRITICAL, f"Using minimum takeoff altitude: {height:.2f} m")
    else:
        target = down
    return autopilot.take_off(target)


def _down(autopilot: Autopilot, command: VehicleCommand) -> float:
    """Return a command's height as local down, m; NaN if it has none."""
    if not abs(command.altitude_m) < _FARTHEST_M:
        return math.nan
    if command.above_home:
        return float(autopilot.snapshot.home_ned_m[2]) - command.altitude_m
    return autopilot.snapshot.origin.altitude_amsl_m - command.altitude_m


def _mode_command(mode: FlightMode) -> Callable[[Autopilot, VehicleCommand, Link], Result]:
    def handler(autopilot: Autopilot, _command: VehicleCommand, _link: Link) -> Result:
        """Enter the mode and return the result."""
        return autopilot.enter_mode(mode)

    return handler


def _reposition(autopilot: Autopilot, command: VehicleCommand, _link: Link) -> Result:
    target = np.array(autopilot.snapshot.truth.position_ned_m)
    latitude, longitude = command.latitude_deg, command.longitude_deg
    if math.isfinite(latitude) and math.isfinite(longitude):
        target[:2] = autopilot.snapshot.origin.local(latitude, longitude)
    down = _down(autopilot, command)
    if not math.isnan(down):
        target[2] = down
    if not np.all(np.abs(target) < _FARTHEST_M):
        return Result.DENIED
    yaw = command.p4 if abs(command.p4) <= math.tau else math.nan
    return autopilot.go_to(target, yaw)


def _change_speed(autopilot: Autopilot, command: VehicleCommand, _link: Link) -> Result:
    if not 0.0 < command.p2 < _FARTHEST_M:
        return Result.DENIED
    autopilot.set_parameter("MPC_XY_CRUISE", command.p2)
    return Result.ACCEPTED


def _terminate(autopilot: Autopilot, command: VehicleCommand, _link: Link) -> Result:
    if command.p1 > 0.5:
        autopilot.commander.terminate("Flight termination active")
    return Result.ACCEPTED


def _set_home(autopilot: Autopilot, command: VehicleCommand, _link: Link) -> Result:
    place = np.array(autopilot.snapshot.truth.position_ned_m)
    if command.p1 != 1.0:
        latitude, longitude = command.latitude_deg, command.longitude_deg
        down = _down(autopilot, command)
        if not all(map(math.isfinite, (latitude, longitude, down))):
            return Result.DENIED
        place[:] = *autopilot.snapshot.origin.local(latitude, longitude), down
    if not autopilot.commander.has_gps_fix or not np.all(np.abs(place) < _FARTHEST_M):
        return Result.TEMPORARILY_REJECTED
    autopilot.set_home(place)
    return Result.ACCEPTED


def _get_home(autopilot: Autopilot, _command: VehicleCommand, link: Link) -> Result:
    return _send_one(autopilot, dialect.MAVLINK_MSG_ID_HOME_POSITION, link)


def _request_message(autopilot: Autopilot, command: VehicleCommand, link: Link) -> Result:
    number = _whole(command.p1)
    return Result.DENIED if number is None else _send_one(autopilot, number, link)


def _request_version(autopilot: Autopilot, _command: VehicleCommand, link: Link) -> Result:
    return _send_one(autopilot, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION, link)


def _send_one(autopilot: Autopilot, number: int, link: Link) -> Result:
    """Send a requested message before the acknowledgement."""
    build = BUILDERS.get(number)
    message = None if build is None else build(autopilot.snapshot)
    if message is None:
        return Result.DENIED
    link.send(message)
    return Result.ACCEPTED


def _set_interval(autopilot: Autopilot, command: VehicleCommand, link: Link) -> Result:
    number = _whole(command.p1)
    if number is None or not math.isfinite(command.p2):
        return Result.FAILED
    known = link.streams.set_interval(number, command.p2, autopilot.snapshot.stamp_us)
    return Result.ACCEPTED if known else Result.FAILED


def _get_interval(_autopilot: Autopilot, command: VehicleCommand, link: Link) -> Result:
    number = _whole(command.p1)
    if number is None or not 0 <= number <= 0xFFFF:
        return Result.FAILED
    interval = link.streams.interval_us(number)
    wire = 0 if interval is None else (interval or -1)  # 0: unavailable, -1: not streamed
    link.send(dialect.MAVLink_message_interval_message(number, int32(wire)))
    return Result.ACCEPTED


def _prearm_checks(_autopilot: Autopilot, _command: VehicleCommand, _link: Link) -> Result:
    return Result.ACCEPTED


def _mission_start(_autopilot: Autopilot, _command: VehicleCommand, _link: Link) -> Result:
    return Result.DENIED  # there is no mission


_HANDLERS: dict[int, Callable[[Autopilot, VehicleCommand, Link], Result | None]] = {
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_TAKEOFF: _takeoff,
    dialect.MAV_CMD_NAV_LAND: _mode_command(FlightMode.LAND),
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: _mode_command(FlightMode.RTL),
    dialect.MAV_CMD_DO_REPOSITION: _reposition,
    dialect.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    dialect.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    dialect.MAV_CMD_DO_SET_HOME: _set_home,
    dialect.MAV_CMD_GET_HOME_POSITION: _get_home,
    dialect.MAV_CMD_REQUEST_MESSAGE: _request_message,
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _request_version,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    dialect.MAV_CMD_RUN_PREARM_CHECKS: _prearm_checks,
    dialect.MAV_CMD_MISSION_START: _mission_start,
}
