"""Handles the autopilot's messages: commands, setpoints, parameters and small services."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mavfi_cli.link.codec import dialect
from sitl.autopilot.autopilot import COMPONENT, Autopilot
from sitl.autopilot.commander import (
    GPS_FIX_US,
    FlightMode,
    Result,
    Setpoint,
    Severity,
    no_setpoint,
)
from sitl.autopilot.parameters import HASH_NAME
from sitl.autopilot.telemetry import BUILDERS, DESCRIPTIONS, Link, int32
from sitl.geodesy import Origin
from sitl.vehicle.cascade import SP_ATTITUDE, SP_BODY_RATES, SP_THRUST

_FORCE_MAGIC = 21196
_INT_UNSET = 0x7FFFFFFF
_FARTHEST_M = 1e6  # larger values in a setpoint count as not controlled
_NOT_REQUESTABLE = dialect.MAVLINK_MSG_ID_MISSION_CURRENT  # streamed all the same, as in PX4
_FTP_NAK = 129
_FTP_FILE_NOT_FOUND = 10

# Coordinate frames and type mask bits of a setpoint.
_LOCAL_NED, _BODY_NED = 1, 8
_ABSOLUTE_ALTITUDE = (0, 5)
_ABOVE_HOME = (3, 6, 10, 11)  # includes the frames above terrain, as the ground is flat
_IGNORE_POSITION, _IGNORE_VELOCITY, _IGNORE_ACCELERATION = 0x0007, 0x0038, 0x01C0
_FORCE, _IGNORE_YAW, _IGNORE_YAW_RATE = 0x0200, 0x0400, 0x0800
# Type mask bits of SET_ATTITUDE_TARGET.
_IGNORE_TILT_RATES, _THRUST_VECTOR, _IGNORE_THRUST, _IGNORE_ATTITUDE = 3, 32, 64, 128
_STEEPEST = 100.0  # m/s^2 or rad/s


def _sender(message: Any) -> tuple[int, int]:
    return message.get_srcSystem(), message.get_srcComponent()


# Commands: a handler takes a COMMAND_LONG or COMMAND_INT, and returns the result to acknowledge.

_CommandHandler = Callable[[Autopilot, Any, Link], Result | None]


def _execute(autopilot: Autopilot, message: Any, link: Link) -> None:
    if message.target_system != autopilot.system_id:
        return
    handler = _COMMANDS.get(message.command)
    result = Result.UNSUPPORTED if handler is None else handler(autopilot, message, link)
    if result is not None:
        link.send(_acknowledge(message, message.command, result))


def _acknowledge(message: Any, number: int, result: Result) -> Any:
    return dialect.MAVLink_command_ack_message(number, int(result), 0, 0, *_sender(message))


def _refuse(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer an untrusted sender: deny a command, or send a parameter's current value."""
    name = message.get_type()
    if name == "SET_MODE" or name.startswith("COMMAND_"):
        number = getattr(message, "command", dialect.MAV_CMD_DO_SET_MODE)
        link.send(_acknowledge(message, number, Result.DENIED))
    elif name == "PARAM_SET":
        index = autopilot.parameters.index(message.param_id)
        if index is not None:
            link.send(autopilot.parameters.message(index))


def _whole(value: float) -> int | None:
    return int(value) if math.isfinite(value) and value == int(value) else None


def _horizontal(autopilot: Autopilot, message: Any) -> tuple[float, float] | None:
    """Return the local north and east, m, of a command's position, or None if it gives none."""
    if message.get_type() == "COMMAND_LONG":
        latitude, longitude = message.param5, message.param6
    elif _INT_UNSET in (message.x, message.y):
        return None
    else:
        latitude, longitude = message.x * 1e-7, message.y * 1e-7
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return None
    return autopilot.snapshot.origin.local(latitude, longitude)


def _down(autopilot: Autopilot, message: Any) -> float:
    """Return a command's height as a local down coordinate, m, or NaN if it gives no height."""
    now, is_long = autopilot.snapshot, message.get_type() == "COMMAND_LONG"
    altitude_m = float(message.param7 if is_long else message.z)
    if not abs(altitude_m) < _FARTHEST_M:
        return math.nan
    is_above_home = not is_long and message.frame in _ABOVE_HOME
    return float(now.home_ned_m[2] if is_above_home else now.origin.altitude_amsl_m) - altitude_m


def _arm_disarm(autopilot: Autopilot, message: Any, _link: Link) -> Result | None:
    commander, force = autopilot.commander, _whole(message.param2) == _FORCE_MAGIC
    if message.param1 == 1.0:
        return commander.request_arm(force=force)
    if message.param1 == 0.0:
        return commander.request_disarm(force=force)
    commander.queue_text(Severity.CRITICAL, "Unsupported ARM_DISARM param")
    return None


def _set_mode(autopilot: Autopilot, message: Any, link: Link) -> Result:
    """Handle DO_SET_MODE, and acknowledge it twice.

    As in PX4, the receiver accepts the command first, and then the commander decides.
    """
    link.send(_acknowledge(message, dialect.MAV_CMD_DO_SET_MODE, Result.ACCEPTED))
    base, main, sub = map(_whole, (message.param1, message.param2, message.param3))
    if base is None or not base & 1 or main is None:
        return Result.TEMPORARILY_REJECTED
    return autopilot.enter_mode(FlightMode.from_numbers(main, sub or 0))


def _guided_enable(autopilot: Autopilot, message: Any, _link: Link) -> Result:
    """Enter OFFBOARD, or the mode before it.

    PX4 up to v1.13 has this command (Commander.cpp), and older companions send it. Later versions
    answer UNSUPPORTED.
    """
    enters = message.param1 > 0.5
    return autopilot.enter_mode(
        FlightMode.OFFBOARD if enters else autopilot.commander.mode_before_offboard
    )


def _takeoff(autopilot: Autopilot, message: Any, _link: Link) -> Result:
    height = autopilot.parameters.effective("MIS_TAKEOFF_ALT")
    target = float(autopilot.snapshot.home_ned_m[2]) - height
    down = _down(autopilot, message)
    queue_text = autopilot.commander.queue_text
    if math.isnan(down):
        queue_text(Severity.INFO, f"Using default takeoff altitude: {height:.1f} m")
    elif down > target + 0.1:
        queue_text(Severity.CRITICAL, f"Using minimum takeoff altitude: {height:.2f} m")
    else:
        target = down
    return autopilot.enter_mode(FlightMode.TAKEOFF, takeoff_down_m=target)


def _reposition(autopilot: Autopilot, message: Any, _link: Link) -> Result:
    target = np.array(autopilot.snapshot.truth.position_ned_m)
    place, down = _horizontal(autopilot, message), _down(autopilot, message)
    if place is not None:
        target[:2] = place
    if not math.isnan(down):
        target[2] = down
    if autopilot.commander.landed or not np.all(np.abs(target) < _FARTHEST_M):
        return Result.DENIED
    yaw = message.param4 if abs(message.param4) <= math.tau else math.nan
    return autopilot.enter_mode(FlightMode.LOITER, hold=(target, yaw))


def _change_speed(autopilot: Autopilot, message: Any, _link: Link) -> Result:
    if not 0.0 < message.param2 < _FARTHEST_M:
        return Result.DENIED
    autopilot.set_parameter("MPC_XY_CRUISE", message.param2)
    return Result.ACCEPTED


def _terminate(autopilot: Autopilot, message: Any, _link: Link) -> Result:
    if message.param1 > 0.5:
        autopilot.commander.terminate("Flight termination active")
    return Result.ACCEPTED


def _set_home(autopilot: Autopilot, message: Any, _link: Link) -> Result:
    place = np.array(autopilot.snapshot.truth.position_ned_m)
    if message.param1 != 1.0:
        horizontal, down = _horizontal(autopilot, message), _down(autopilot, message)
        if horizontal is None or math.isnan(down):
            return Result.DENIED
        place[:] = *horizontal, down
    if not autopilot.commander.has_gps_fix or not np.all(np.abs(place) < _FARTHEST_M):
        return Result.TEMPORARILY_REJECTED
    autopilot.set_home(place)
    return Result.ACCEPTED


def _request_message(autopilot: Autopilot, message: Any, link: Link) -> Result:
    number = _whole(message.param1)
    if number is None or number == _NOT_REQUESTABLE:
        return Result.DENIED
    return _send(autopilot, link, number, index=_whole(message.param2) or 0)


def _send(autopilot: Autopilot, link: Link, number: int, *, index: int = 0) -> Result:
    """Send a requested message, or the messages that `index` selects.

    Return ACCEPTED, or DENIED if there is no such message to send.
    """
    if number in DESCRIPTIONS:
        messages = DESCRIPTIONS[number](autopilot.snapshot, index)
    else:
        message = BUILDERS[number](autopilot.snapshot) if number in BUILDERS else None
        messages = [] if message is None else [message]
    for message in messages:
        link.send(message)
    return Result.ACCEPTED if messages else Result.DENIED


def _set_interval(autopilot: Autopilot, message: Any, link: Link) -> Result:
    number = _whole(message.param1)
    if number is None or not math.isfinite(message.param2):
        return Result.FAILED
    known = link.set_interval(number, message.param2, autopilot.snapshot.stamp_us)
    return Result.ACCEPTED if known else Result.FAILED


def _get_interval(_autopilot: Autopilot, message: Any, link: Link) -> Result:
    number = _whole(message.param1)
    if number is None or not 0 <= number <= 0xFFFF:
        return Result.FAILED
    interval = link.interval_us(number)
    wire = 0 if interval is None else (interval or -1)  # 0: unavailable, -1: not streamed
    link.send(dialect.MAVLink_message_interval_message(number, int32(wire)))
    return Result.ACCEPTED


def _reboot(autopilot: Autopilot, message: Any, link: Link) -> Result:
    """Request a restart of the simulation, if the vehicle is disarmed or terminated."""
    if _whole(message.param1) != 1 or link.in_lockstep:
        return Result.UNSUPPORTED
    if autopilot.snapshot.stamp_us < GPS_FIX_US:
        return Result.TEMPORARILY_REJECTED  # still booting
    if autopilot.commander.armed and not autopilot.commander.terminated:
        autopilot.commander.queue_text(Severity.CRITICAL, "Reboot denied: armed")
        return Result.TEMPORARILY_REJECTED
    autopilot.restart_requested = True
    return Result.ACCEPTED


_COMMANDS: Mapping[int, _CommandHandler] = {
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_GUIDED_ENABLE: _guided_enable,
    dialect.MAV_CMD_NAV_TAKEOFF: _takeoff,
    dialect.MAV_CMD_NAV_LAND: lambda autopilot, *_: autopilot.enter_mode(FlightMode.LAND),
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda autopilot, *_: autopilot.enter_mode(
        FlightMode.RTL
    ),
    dialect.MAV_CMD_DO_REPOSITION: _reposition,
    dialect.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    dialect.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    dialect.MAV_CMD_DO_SET_HOME: _set_home,
    dialect.MAV_CMD_GET_HOME_POSITION: lambda autopilot, _message, link: _send(
        autopilot, link, dialect.MAVLINK_MSG_ID_HOME_POSITION
    ),
    dialect.MAV_CMD_REQUEST_MESSAGE: _request_message,
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: lambda autopilot, _message, link: _send(
        autopilot, link, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    ),
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    dialect.MAV_CMD_RUN_PREARM_CHECKS: lambda *_: Result.ACCEPTED,
    dialect.MAV_CMD_MISSION_START: lambda *_: Result.DENIED,  # there is no mission
}


# Setpoints, by PX4's rules ------------------------------------------------------------------------


def _take_setpoint(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Make a setpoint the newest one of the companion, if its sender may give setpoints now."""
    now = autopilot.snapshot
    try:
        if message.get_type() == "SET_ATTITUDE_TARGET":
            setpoint = _attitude_setpoint(message)
        else:
            heading_rad, home_down_m = now.truth.euler_rad[2], float(now.home_ned_m[2])
            setpoint = setpoint_of(message, heading_rad, now.origin, home_down_m)
    except ValueError as error:
        autopilot.commander.queue_text(Severity.CRITICAL, f"{message.get_type()} {error}")
        return
    silence_us = autopilot.parameters.effective("COM_OF_LOSS_T") * 1e6
    if autopilot.authority.follows(message, link, now.stamp_us, silence_us):
        now.offboard = setpoint
        autopilot.commander.input_arrived(FlightMode.OFFBOARD)


def _attitude_setpoint(message: Any) -> Setpoint:
    """Return the setpoint (19,) that a SET_ATTITUDE_TARGET message gives.

    It has a thrust, and either an attitude, with an optional yaw rate, or body rates.

    Raises:
        ValueError: the type mask or a value is not supported.
    """
    mask, out = message.type_mask, no_setpoint()
    if mask & (_IGNORE_THRUST | _THRUST_VECTOR):
        raise ValueError("without a collective thrust not supported")
    if not 0.0 <= message.thrust <= 1.0:
        raise ValueError("thrust invalid")
    out[SP_THRUST] = message.thrust
    rates = message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate
    if not mask & _IGNORE_ATTITUDE:
        norm = math.sqrt(math.fsum(part * part for part in message.q))
        if not 0.5 < norm < 2.0:
            raise ValueError("quaternion invalid")
        out[SP_ATTITUDE : SP_ATTITUDE + 4] = message.q
        _fill(out, SP_BODY_RATES, rates, mask | _IGNORE_TILT_RATES, _STEEPEST)
    elif mask & _IGNORE_TILT_RATES:
        raise ValueError("invalid")
    else:
        _fill(out, SP_BODY_RATES, rates, mask, _STEEPEST)
    return out


def setpoint_of(message: Any, heading_rad: float, origin: Origin, home_down_m: float) -> Setpoint:
    """Return the setpoint (19,), in NED, that a SET_POSITION_TARGET message gives.

    A BODY_NED setpoint is rotated by the heading (rad, from north). The altitude of a global
    setpoint is above sea level or above home, depending on the frame. Raises ValueError if frame or
    type mask is not supported.
    """
    frame, mask = message.coordinate_frame, message.type_mask
    is_local = message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
    if frame not in ((_LOCAL_NED, _BODY_NED) if is_local else _ABSOLUTE_ALTITUDE + _ABOVE_HOME):
        raise ValueError(f"coordinate frame {frame} unsupported")
    if frame == _BODY_NED:
        mask |= _IGNORE_POSITION  # PX4 accepts positions in the local frame only
    _check_mask(mask)
    out = no_setpoint()
    if mask & _IGNORE_POSITION != _IGNORE_POSITION:
        if is_local:
            place = message.x, message.y, message.z
        else:
            down = (home_down_m if frame in _ABOVE_HOME else origin.altitude_amsl_m) - message.alt
            place = *origin.local(message.lat_int * 1e-7, message.lon_int * 1e-7), down
        _fill(out, 0, place, mask, _FARTHEST_M)
    _fill(out, 3, (message.vx, message.vy, message.vz), mask >> 3, _FARTHEST_M)
    _fill(out, 6, (message.afx, message.afy, message.afz), mask >> 6, _STEEPEST)
    if not mask & _IGNORE_YAW and math.isfinite(message.yaw):
        out[9] = math.remainder(message.yaw, math.tau)
    if not mask & _IGNORE_YAW_RATE and abs(message.yaw_rate) < _STEEPEST:
        out[10] = message.yaw_rate
    if frame == _BODY_NED:
        _turn(out, heading_rad)
    return out


def _check_mask(mask: int) -> None:
    """Raise ValueError if a type mask is not supported."""
    accelerates = mask & _IGNORE_ACCELERATION != _IGNORE_ACCELERATION
    if accelerates and mask & _FORCE:  # the bit turns the acceleration fields into forces
        raise ValueError("force not supported")
    if not ~mask & (_IGNORE_POSITION | _IGNORE_VELOCITY):
        problem = "acceleration without velocity not supported" if accelerates else "invalid"
        raise ValueError(problem)


def _fill(
    out: Setpoint, start: int, values: tuple[float, float, float], ignored: int, limit: float
) -> None:
    """Write to `out`, from index `start`, the values that the mask `ignored` does not ignore.

    NaN and values beyond `limit` are omitted.
    """
    for axis, value in enumerate(values):
        if not ignored >> axis & 1 and abs(value) <= limit:
            out[start + axis] = value


def _turn(out: Setpoint, heading_rad: float) -> None:
    """Rotate a setpoint's velocity and acceleration from forward-right to north-east, in place."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    for start in (3, 6):
        if not np.isnan(out[start : start + 2]).all():
            forward, right = np.nan_to_num(out[start : start + 2])
            out[start] = cosine * forward - sine * right
            out[start + 1] = sine * forward + cosine * right


# Other messages -----------------------------------------------------------------------------------


def _set_mode_message(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Handle SET_MODE, the predecessor of DO_SET_MODE, and acknowledge it once."""
    if message.target_system != autopilot.system_id:
        return
    mode, custom = None, message.custom_mode
    if message.base_mode & 1:
        mode = FlightMode.from_numbers(custom >> 16 & 0xFF, custom >> 24 & 0xFF)
    result = autopilot.enter_mode(mode)
    link.send(_acknowledge(message, dialect.MAV_CMD_DO_SET_MODE, result))


def _manual_control(autopilot: Autopilot, message: Any, _link: Link) -> None:
    if message.target == autopilot.system_id:
        autopilot.snapshot.sticks = (message.x, message.y, message.z, message.r)
        autopilot.commander.input_arrived(FlightMode.POSCTL)


def _param_request_list(autopilot: Autopilot, _message: Any, link: Link) -> None:
    """Start listing all parameters: the hash first, then a few per tick."""
    link.send(autopilot.parameters.hash_message())
    link.parameters_left = deque(range(len(autopilot.parameters)))


def _param_request_read(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Send one parameter by its index, or by its name if the index is -1.

    A request for an unknown parameter is not answered.
    """
    store, index = autopilot.parameters, message.param_index
    if index < 0 and message.param_id == HASH_NAME:
        link.send(store.hash_message())
        return
    index = store.index(message.param_id) if index < 0 else index
    if index is not None and index < len(store):
        link.send(store.message(index))


def _param_set(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Store a parameter. Answer on this link, and broadcast a changed value to all links."""
    if message.param_id == HASH_NAME:
        link.parameters_left.clear()  # the client's cache is valid and needs no list
        return
    store = autopilot.parameters
    changed = store.write(message.param_id, message.param_value, message.param_type)
    index = store.index(message.param_id)
    if changed is None or index is None:
        return
    link.send(store.message(index))
    if changed:
        autopilot.broadcast(store.message(index))


def _mission_ack(_autopilot: Autopilot, message: Any, link: Link) -> None:
    """Accept a request to clear the mission or to upload an empty one. Refuse anything else."""
    result = dialect.MAV_MISSION_ACCEPTED
    if message.get_type().startswith("MISSION_REQUEST"):
        result = dialect.MAV_MISSION_INVALID_SEQUENCE
    elif getattr(message, "count", 0):
        result = dialect.MAV_MISSION_UNSUPPORTED
    link.send(dialect.MAVLink_mission_ack_message(*_sender(message), result, message.mission_type))


def _file_transfer(_autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer with a NAK: the autopilot has no files, and without an answer the client retries."""
    sequence, session, opcode = struct.unpack_from("<HBB", bytes(message.payload))
    head = (sequence + 1) & 0xFFFF, session, _FTP_NAK, 1, opcode, 0, 0, _FTP_FILE_NOT_FOUND
    reply = struct.pack("<HBBBBBxIB", *head).ljust(251, b"\0")
    link.send(dialect.MAVLink_file_transfer_protocol_message(0, *_sender(message), reply))


def _timesync(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer a TIMESYNC request (tc1 = 0) with the boot clock in nanoseconds."""
    if message.tc1 == 0:
        now_ns = max(autopilot.snapshot.stamp_us * 1000, 1)
        link.send(dialect.MAVLink_timesync_message(now_ns, message.ts1))


def _ping(_autopilot: Autopilot, message: Any, link: Link) -> None:
    """Answer a broadcast ping with an echo that is addressed to its sender."""
    if message.target_system == 0 and message.target_component == 0:
        link.send(dialect.MAVLink_ping_message(message.time_usec, message.seq, *_sender(message)))


_Service = Callable[[Autopilot, Any, Link], None]

ADDRESSED: Mapping[int, _Service] = {
    dialect.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: _param_request_list,
    dialect.MAVLINK_MSG_ID_PARAM_REQUEST_READ: _param_request_read,
    dialect.MAVLINK_MSG_ID_PARAM_SET: _param_set,
    dialect.MAVLINK_MSG_ID_MISSION_REQUEST_LIST: lambda _autopilot, message, link: link.send(
        dialect.MAVLink_mission_count_message(*_sender(message), 0, message.mission_type)
    ),
    dialect.MAVLINK_MSG_ID_MISSION_COUNT: _mission_ack,
    dialect.MAVLINK_MSG_ID_MISSION_CLEAR_ALL: _mission_ack,
    dialect.MAVLINK_MSG_ID_MISSION_REQUEST: _mission_ack,
    dialect.MAVLINK_MSG_ID_MISSION_REQUEST_INT: _mission_ack,
    dialect.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL: _file_transfer,
    dialect.MAVLINK_MSG_ID_LOG_REQUEST_LIST: lambda _autopilot, _message, link: link.send(
        dialect.MAVLink_log_entry_message(0, 0, 0, 0, 0)  # there are none
    ),
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: _take_setpoint,
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT: _take_setpoint,
    dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: _take_setpoint,
    dialect.MAVLINK_MSG_ID_COMMAND_LONG: _execute,
    dialect.MAVLINK_MSG_ID_COMMAND_INT: _execute,
}
"""Services by message id, for messages that name the autopilot as their target."""

ANY_TARGET: Mapping[int, _Service] = {
    dialect.MAVLINK_MSG_ID_TIMESYNC: _timesync,
    dialect.MAVLINK_MSG_ID_PING: _ping,
    dialect.MAVLINK_MSG_ID_SET_MODE: _set_mode_message,
    dialect.MAVLINK_MSG_ID_MANUAL_CONTROL: _manual_control,
}
"""Services by message id, for messages with any target."""


def handle(autopilot: Autopilot, message: Any, link: Link) -> None:
    """Handle a message from a client. Messages for other systems are ignored."""
    number = message.get_msgId()
    is_addressed = _is_addressed(message, autopilot.system_id)
    if not autopilot.authority.may_command(message, link):
        if is_addressed:
            _refuse(autopilot, message, link)
    elif number in ANY_TARGET:
        ANY_TARGET[number](autopilot, message, link)
    elif number in ADDRESSED and is_addressed:
        ADDRESSED[number](autopilot, message, link)
    autopilot.flush_texts()


def _is_addressed(message: Any, system: int) -> bool:
    """Return True if a message is addressed to the autopilot of `system`, or broadcast."""
    if not hasattr(message, "target_component"):  # SET_MODE, MANUAL_CONTROL
        return getattr(message, "target_system", None) == system
    return message.target_system in (system, 0) and message.target_component in (COMPONENT, 0)
