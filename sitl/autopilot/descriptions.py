"""What the autopilot is and can do: messages that are sent on request only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mavfi_cli.link.added_messages import (
    AvailableModes,
    ComponentInformation,
    ComponentMetadata,
    ProtocolVersion,
)
from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import FlightMode
from sitl.autopilot.telemetry import UNIX_EPOCH_S, Snapshot

_NOT_SELECTABLE = 2  # MAV_MODE_PROPERTY_NOT_USER_SELECTABLE
_STANDARD_MODES = {
    FlightMode.POSCTL: dialect.MAV_STANDARD_MODE_POSITION_HOLD,
    FlightMode.TAKEOFF: dialect.MAV_STANDARD_MODE_TAKEOFF,
    FlightMode.RTL: dialect.MAV_STANDARD_MODE_SAFE_RECOVERY,
    FlightMode.LAND: dialect.MAV_STANDARD_MODE_LAND,
}


def _protocol_version(_now: Snapshot, _index: int) -> list[Any]:
    """Return PROTOCOL_VERSION: MAVLink 2, and 1 is understood."""
    return [ProtocolVersion(200, 100, 200, [0] * 8, [0] * 8)]


def _flight_information(now: Snapshot, _index: int) -> list[Any]:
    """Return FLIGHT_INFORMATION with the time of arming; 0 while disarmed."""
    armed_us = 0
    if now.commander.armed:
        armed_us = UNIX_EPOCH_S * 1_000_000 + now.stamp_us - round(now.commander.armed_for_s * 1e6)
    return [dialect.MAVLink_flight_information_message(now.boot_ms, armed_us, 0, 0)]


def _component_metadata(now: Snapshot, _index: int) -> list[Any]:
    """Return COMPONENT_METADATA. There is no file, as there is no file transfer."""
    return [ComponentMetadata(now.boot_ms, 0, b"")]


def _component_information(now: Snapshot, _index: int) -> list[Any]:
    """Return COMPONENT_INFORMATION, the predecessor of COMPONENT_METADATA."""
    return [ComponentInformation(now.boot_ms, 0, 0, b"", b"")]


def _available_modes(_now: Snapshot, index: int) -> list[Any]:
    """Return AVAILABLE_MODES of one mode, counted from 1, or of all for 0."""
    modes = list(FlightMode)
    return [
        AvailableModes(
            mode.custom_mode, _NOT_SELECTABLE if mode is FlightMode.MANUAL else 0, len(modes),
            number, _STANDARD_MODES.get(mode, 0), mode.label.encode(),
        )
        for number, mode in enumerate(modes, 1)
        if index in (0, number)
    ]  # fmt: skip


DESCRIPTIONS: Mapping[int, Callable[[Snapshot, int], list[Any]]] = {
    dialect.MAVLINK_MSG_ID_FLIGHT_INFORMATION: _flight_information,
    ProtocolVersion.id: _protocol_version,
    ComponentInformation.id: _component_information,
    ComponentMetadata.id: _component_metadata,
    AvailableModes.id: _available_modes,
}
"""Builders by message id; the second argument is param2 of the request."""
