"""What the autopilot does with each message: commands, setpoints, parameters and small services."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import GPS_FIX_US, FlightMode, Result, Severity
from sitl.autopilot.parameters import HASH_INDEX, HASH_NAME, SetResult
from sitl.autopilot.setpoint import SetpointRefused, global_setpoint, local_setpoint
from sitl.autopilot.streams import Link
from sitl.autopilot.telemetry import BUILDERS, DESCRIPTIONS, int32

if TYPE_CHECKING:
    from sitl.autopilot.autopilot import Autopilot

_FORCE_MAGIC = 21196
_INT_UNSET = 0x7FFFFFFF
_RELATIVE_FRAMES = (3, 6, 10, 11)
_FARTHEST_M = 1e6
_NOT_REQUESTABLE = (dialect.MAVLINK_MSG_ID_MISSION_CURRENT,)  # as in PX4, though streamed
_FTP_NAK = 129
_FTP_FILE_NOT_FOUND = 10


# Commands.


@dataclass(frozen=True, slots=True, kw_only=True)
class _Command:
    """A command from either message. Missing parameters are NaN."""

    message: Any
    p1: float
    p2: float
    p3: float
    p4: float
    latitude_deg: float  # p5 of a COMMAND_LONG
    longitude_deg: float  # p6
    altitude_m: float  # p7
    above_home: bool  # altitude above home; otherwise above sea level


_Handler = Callable[["Autopilot", _Command, Link], Result | None]


def _command_of(message: Any) -> _Command:
    if message.get_type() == "COMMAND_LONG":
        place, above_home = (message.param5, message.param6, message.param7), False
    else:
        place = (_degrees(message.x), _degrees(message.y), message.z)
        above_home = message.frame in _RELATIVE_FRAMES
    return _Command(
        message=message, p1=message.param1, p2=message.param2, p3=message.param3,
        p4=message.param4, latitude_deg=place[0], longitude_deg=place[1], altitude_m=place[2],
        above_home=above_home,
    )  # fmt: skip


def _degrees(value: int) -> float:
    return math.nan if value == _INT_UNSET else value * 1e-7


def _acknowledge(message: Any, number: int, result: Result) -> Any:
    """Return the COMMAND_ACK of a command number to the sender of a message."""
    return dialect.MAVLink_command_ack_message(
        number, int(result), 0, 0, message.get_srcSystem(), message.get_srcComponent()
    )


def _whole(value: float) -> int | None:
    """Return an integer parameter; None if it is not an integer."""
    return int(value) if math.isfinite(value) and value == int(value) else None


def _execute(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Execute a COMMAND_LONG or COMMAND_INT for this system by name, and acknowledge it."""
    if message.target_system != autopilot.system_id:
        return
    handler = _COMMANDS.get(message.command)
    result: Result | None = Result.UNSUPPORTED
    if handler is not None:
        result = handler(autopilot, _command_of(message), link)
    if result is not None:
        link.send(_acknowledge(message, message.command, result))


def refuse(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer a sender that may not command: commands are denied, a parameter keeps its value."""
    name = message.get_type()
    if name == "SET_MODE":
        link.send(_acknowledge(message, dialect.MAV_CMD_DO_SET_MODE, Result.DENIED))
    elif name.startswith("COMMAND_"):
        link.send(_acknowledge(message, message.command, Result.DENIED))
    elif name == "PARAM_SET":
        index = autopilot.parameters.index(message.param_id)
        if index is not None:
            link.send(autopilot.parameters.message(index))


def _arm_disarm(autopilot: Autopilot, command: _Command, _link: Link) -> Result | None:
    force = _whole(command.p2) == _FORCE_MAGIC
    if command.p1 == 1.0:
        return autopilot.commander.request_arm(force=force)
    if command.p1 == 0.0:
        return autopilot.commander.request_disarm(force=force)
    autopilot.commander.say(Severity.CRITICAL, "Unsupported ARM_DISARM param")
    return None


def _set_mode(autopilot: Autopilot, command: _Command, link: Link) -> Result:
    """Answer twice like PX4: its receiver acknowledges first, then its commander decides."""
    link.send(_acknowledge(command.message, dialect.MAV_CMD_DO_SET_MODE, Result.ACCEPTED))
    base, main, sub = (_whole(value) for value in (command.p1, command.p2, command.p3))
    if base is None or not base & 1 or main is None:
        return Result.TEMPORARILY_REJECTED
    return autopilot.enter_mode(FlightMode.from_numbers(main, sub or 0))


def _takeoff(autopilot: Autopilot, command: _Command, _link: Link) -> Result:
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


def _down(autopilot: Autopilot, command: _Command) -> float:
    """Return a command's height as local down, m; NaN if it has none."""
    if not abs(command.altitude_m) < _FARTHEST_M:
        return math.nan
    if command.above_home:
        return float(autopilot.snapshot.home_ned_m[2]) - command.altitude_m
    return autopilot.snapshot.origin.altitude_amsl_m - command.altitude_m


def _mode_command(mode: FlightMode) -> _Handler:
    return lambda autopilot, _command, _link: autopilot.enter_mode(mode)


def _reposition(autopilot: Autopilot, command: _Command, _link: Link) -> Result:
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


def _change_speed(autopilot: Autopilot, command: _Command, _link: Link) -> Result:
    if not 0.0 < command.p2 < _FARTHEST_M:
        return Result.DENIED
    autopilot.set_parameter("MPC_XY_CRUISE", command.p2)
    return Result.ACCEPTED


def _terminate(autopilot: Autopilot, command: _Command, _link: Link) -> Result:
    if command.p1 > 0.5:
        autopilot.commander.terminate("Flight termination active")
    return Result.ACCEPTED


def _set_home(autopilot: Autopilot, command: _Command, _link: Link) -> Result:
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


def _send(number: int) -> _Handler:
    return lambda autopilot, _command, link: _send_one(autopilot, number, link)


def _request_message(autopilot: Autopilot, command: _Command, link: Link) -> Result:
    number = _whole(command.p1)
    if number is None or number in _NOT_REQUESTABLE:
        return Result.DENIED
    describe = DESCRIPTIONS.get(number)
    if describe is None:
        return _send_one(autopilot, number, link)
    messages = describe(autopilot.snapshot, _whole(command.p2) or 0)
    for message in messages:
        link.send(message)
    return Result.ACCEPTED if messages else Result.DENIED


def _send_one(autopilot: Autopilot, number: int, link: Link) -> Result:
    """Send a requested message before the acknowledgement."""
    build = BUILDERS.get(number)
    message = None if build is None else build(autopilot.snapshot)
    if message is None:
        return Result.DENIED
    link.send(message)
    return Result.ACCEPTED


def _set_interval(autopilot: Autopilot, command: _Command, link: Link) -> Result:
    number = _whole(command.p1)
    if number is None or not math.isfinite(command.p2):
        return Result.FAILED
    known = link.set_interval(number, command.p2, autopilot.snapshot.stamp_us)
    return Result.ACCEPTED if known else Result.FAILED


def _get_interval(_autopilot: Autopilot, command: _Command, link: Link) -> Result:
    number = _whole(command.p1)
    if number is None or not 0 <= number <= 0xFFFF:
        return Result.FAILED
    interval = link.interval_us(number)
    wire = 0 if interval is None else (interval or -1)  # 0: unavailable, -1: not streamed
    link.send(dialect.MAVLink_message_interval_message(number, int32(wire)))
    return Result.ACCEPTED


def _reboot(autopilot: Autopilot, command: _Command, link: Link) -> Result:
    """Restart the simulation at its start, from the ground or as a wreck."""
    if _whole(command.p1) != 1 or link.in_lockstep:
        return Result.UNSUPPORTED
    if autopilot.snapshot.stamp_us < GPS_FIX_US:
        return Result.TEMPORARILY_REJECTED  # still booting
    if autopilot.commander.armed and not autopilot.commander.terminated:
        autopilot.commander.say(Severity.CRITICAL, "Reboot denied: armed")
        return Result.TEMPORARILY_REJECTED
    autopilot.restart_asked = True
    return Result.ACCEPTED


def _always(result: Result) -> _Handler:
    return lambda _autopilot, _command, _link: result


_COMMANDS: dict[int, _Handler] = {
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_TAKEOFF: _takeoff,
    dialect.MAV_CMD_NAV_LAND: _mode_command(FlightMode.LAND),
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: _mode_command(FlightMode.RTL),
    dialect.MAV_CMD_DO_REPOSITION: _reposition,
    dialect.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    dialect.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    dialect.MAV_CMD_DO_SET_HOME: _set_home,
    dialect.MAV_CMD_GET_HOME_POSITION: _send(dialect.MAVLINK_MSG_ID_HOME_POSITION),
    dialect.MAV_CMD_REQUEST_MESSAGE: _request_message,
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _send(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    dialect.MAV_CMD_RUN_PREARM_CHECKS: _always(Result.ACCEPTED),
    dialect.MAV_CMD_MISSION_START: _always(Result.DENIED),  # there is no mission
}


# Other messages.


def _position_target(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Take a setpoint of SET_POSITION_TARGET_LOCAL_NED or _GLOBAL_INT."""
    now = autopilot.snapshot
    try:
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            setpoint = local_setpoint(message, now.truth.euler_rad[2])
        else:
            setpoint = global_setpoint(message, now.origin, float(now.home_ned_m[2]))
    except SetpointRefused as refusal:
        autopilot.commander.say(Severity.CRITICAL, str(refusal))
        return
    silence_us = autopilot.parameters.effective("COM_OF_LOSS_T") * 1e6
    if autopilot.authority.follows(message, link, now.stamp_us, silence_us):
        now.offboard = setpoint
        autopilot.commander.offboard_setpoint_arrived()


def _attitude_target(autopilot: Autopilot, _message: Any, _link: Link) -> None:
    autopilot.commander.say(Severity.CRITICAL, "SET_ATTITUDE_TARGET not supported")


def _set_mode_message(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Handle SET_MODE, the predecessor of DO_SET_MODE, with one answer."""
    if message.target_system != autopilot.system_id:
        return
    mode = FlightMode.from_custom(message.custom_mode) if message.base_mode & 1 else None
    result = autopilot.enter_mode(mode)
    link.send(_acknowledge(message, dialect.MAV_CMD_DO_SET_MODE, result))


def _manual_control(autopilot: Autopilot, message: Any, _link: Link) -> None:
    if message.target == autopilot.system_id:
        autopilot.snapshot.sticks = (message.x, message.y, message.z, message.r)
        autopilot.commander.sticks_arrived()


def _param_request_list(autopilot: Autopilot, _message: Any, link: Link) -> None:
    """Start to list all parameters: the hash first, then a few per tick."""
    link.send(autopilot.parameters.hash_message())
    link.parameters_left.clear()
    link.parameters_left.extend(range(len(autopilot.parameters)))


def _param_request_read(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Send one parameter by index, or by name if the index is -1; no answer if unknown."""
    if message.param_index < 0:
        if message.param_id == HASH_NAME:
            link.send(autopilot.parameters.hash_message())
            return
        index = autopilot.parameters.index(message.param_id)
    elif message.param_index == HASH_INDEX:
        index = None
    else:
        index = message.param_index
    if index is not None and index < len(autopilot.parameters):
        link.send(autopilot.parameters.message(index))


def _param_set(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Store a value, answer on this link, and broadcast a change to all."""
    if message.param_id == HASH_NAME:
        link.parameters_left.clear()  # the client's cache is valid and needs no list
        return
    store = autopilot.parameters
    result = store.write(message.param_id, message.param_value, message.param_type)
    index = store.index(message.param_id)
    if result is SetResult.IGNORED or index is None:
        return
    link.send(store.message(index))
    if result is SetResult.CHANGED:
        autopilot.broadcast(store.message(index))


def _mission_request_list(_autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer that there are no mission items."""
    link.send(
        dialect.MAVLink_mission_count_message(
            message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
        )
    )


def _mission_ack(_autopilot: Autopilot, message: Any, link: Link) -> None:
    """Accept to clear the mission, also by an empty upload. No item and no upload exists."""
    result = dialect.MAV_MISSION_ACCEPTED
    if message.get_type().startswith("MISSION_REQUEST"):
        result = dialect.MAV_MISSION_INVALID_SEQUENCE
    elif getattr(message, "count", 0):
        result = dialect.MAV_MISSION_UNSUPPORTED
    link.send(
        dialect.MAVLink_mission_ack_message(
            message.get_srcSystem(), message.get_srcComponent(), result, message.mission_type
        )
    )


def _file_transfer(_autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer with a NAK, as there are no files, to stop the client's retries."""
    request = bytes(message.payload)
    sequence, session, opcode = struct.unpack_from("<HBB", request)
    reply = struct.pack(
        "<HBBBBBxIB", (sequence + 1) & 0xFFFF, session, _FTP_NAK, 1, opcode, 0, 0,
        _FTP_FILE_NOT_FOUND,
    )  # fmt: skip
    link.send(
        dialect.MAVLink_file_transfer_protocol_message(
            0, message.get_srcSystem(), message.get_srcComponent(), reply.ljust(251, b"\0")
        )
    )


def _log_request_list(_autopilot: Autopilot, _message: Any, link: Link) -> None:
    """Answer that there are no logs."""
    link.send(dialect.MAVLink_log_entry_message(0, 0, 0, 0, 0))


def _timesync(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer a request (tc1 = 0) with the boot clock, ns."""
    if message.tc1 == 0:
        now_ns = max(autopilot.snapshot.stamp_us * 1000, 1)
        link.send(dialect.MAVLink_timesync_message(now_ns, message.ts1))


def _ping(_autopilot: Autopilot, message: Any, link: Link) -> None:
    """Echo a broadcast ping with the sender's ids."""
    if message.target_system == 0 and message.target_component == 0:
        system, component = message.get_srcSystem(), message.get_srcComponent()
        link.send(dialect.MAVLink_ping_message(message.time_usec, message.seq, system, component))


Service = Callable[["Autopilot", Any, Link], None]

ADDRESSED: Mapping[int, Service] = {
    dialect.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: _param_request_list,
    dialect.MAVLINK_MSG_ID_PARAM_REQUEST_READ: _param_request_read,
    dialect.MAVLINK_MSG_ID_PARAM_SET: _param_set,
    dialect.MAVLINK_MSG_ID_MISSION_REQUEST_LIST: _mission_request_list,
    dialect.MAVLINK_MSG_ID_MISSION_COUNT: _mission_ack,
    dialect.MAVLINK_MSG_ID_MISSION_CLEAR_ALL: _mission_ack,
    dialect.MAVLINK_MSG_ID_MISSION_REQUEST: _mission_ack,
    dialect.MAVLINK_MSG_ID_MISSION_REQUEST_INT: _mission_ack,
    dialect.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL: _file_transfer,
    dialect.MAVLINK_MSG_ID_LOG_REQUEST_LIST: _log_request_list,
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: _position_target,
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT: _position_target,
    dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: _attitude_target,
    dialect.MAVLINK_MSG_ID_COMMAND_LONG: _execute,
    dialect.MAVLINK_MSG_ID_COMMAND_INT: _execute,
}
"""Services by message id, for messages that name the autopilot as their target."""

ANY_TARGET: Mapping[int, Service] = {
    dialect.MAVLINK_MSG_ID_TIMESYNC: _timesync,
    dialect.MAVLINK_MSG_ID_PING: _ping,
    dialect.MAVLINK_MSG_ID_SET_MODE: _set_mode_message,
    dialect.MAVLINK_MSG_ID_MANUAL_CONTROL: _manual_control,
}
"""Services by message id, for messages whatever their target is."""
