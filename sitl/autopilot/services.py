"""Small MAVLink services: parameters, missions, files, logs, time and ping."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from mavfi_cli.link.codec import dialect
from sitl.autopilot.parameters import HASH_INDEX, HASH_NAME, SetResult
from sitl.autopilot.streams import Link

if TYPE_CHECKING:
    from sitl.autopilot.autopilot import Autopilot

_PARAMETERS_A_TICK = 20  # about 1000 per second, as in PX4

_FTP_NAK = 129
_FTP_FILE_NOT_FOUND = 10


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


def list_parameters(autopilot: Autopilot, link: Link) -> None:
    """Send the next few parameters of a list in progress."""
    for _ in range(min(_PARAMETERS_A_TICK, len(link.parameters_left))):
        link.send(autopilot.parameters.message(link.parameters_left.popleft()))


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
}
"""Services by message id, for messages that name the autopilot as their target."""

ANY_TARGET: Mapping[int, Service] = {
    dialect.MAVLINK_MSG_ID_TIMESYNC: _timesync,
    dialect.MAVLINK_MSG_ID_PING: _ping,
}
"""Services by message id, for messages whatever their target is."""
