"""Telemetry of identity, status and capabilities."""

from __future__ import annotations

from typing import Any

from mavfi_cli.link.codec import dialect
from sitl.autopilot.modes import base_mode
from sitl.autopilot.snapshot import UNIX_EPOCH_S, Snapshot, clip, int16, uint16

_QUADROTOR = 2
_PX4 = 12
_PREARM_CHECK = 1 << 28
_GPS = 0x20
_PRESENT = 0x0300402F  # as in PX4 v1.17 SITL
_ENABLED = 0x0301402F
_HEALTH = 0x0320C83F

# Implemented MAV_PROTOCOL_CAPABILITY: MISSION_INT, COMMAND_INT, PARAM_ENCODE_BYTEWISE,
# SET_POSITION_TARGET_GLOBAL_INT, SET_POSITION_TARGET_LOCAL_NED, FLIGHT_TERMINATION, MAVLINK2.
_CAPABILITIES = 4 | 8 | 16 | 256 | 128 | 2048 | 8192
_FLIGHT_VERSION = 0x011100FF  # 1.17.0 official
_UNIQUE_ID = 0x4D41564649  # "MAVFI"

_BATTERY_LIPO = 1
_BATTERY_ALL = 1
_CHARGE_OK = 1
_MISSION_NO_MISSION = 1
_ESTIMATOR_GOOD = 0x33F
_ESTIMATOR_NO_POSITION = 0x027


def heartbeat(s: Snapshot) -> Any:
    """HEARTBEAT."""
    commander = s.commander
    mode = commander.mode
    return dialect.MAVLink_heartbeat_message(
        _QUADROTOR, _PX4, base_mode(mode, armed=commander.armed), mode.custom_mode,
        int(commander.system_status), 3,
    )  # fmt: skip


def sys_status(s: Snapshot) -> Any:
    """Return SYS_STATUS. PREARM_CHECK appears in the health bits only, as in PX4."""
    gps = _GPS if s.commander.has_gps_fix else 0
    health = _HEALTH & ~_GPS | gps
    if s.commander.can_arm:
        health |= _PREARM_CHECK
    truth = s.truth
    return dialect.MAVLink_sys_status_message(
        _PRESENT & ~_GPS | gps, _ENABLED, health, 250, uint16(truth.battery_voltage_v * 1e3),
        int16(truth.battery_current_a * 100.0), clip(truth.battery_remaining * 100.0, 0, 100),
        0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def extended_sys_state(s: Snapshot) -> Any:
    """EXTENDED_SYS_STATE."""
    return dialect.MAVLink_extended_sys_state_message(0, int(s.commander.landed_state))


def battery_status(s: Snapshot) -> Any:
    """Return BATTERY_STATUS with equal cell voltages."""
    truth = s.truth
    cells = min(max(int(s.parameters.value("BAT1_N_CELLS")), 1), 10)
    each = uint16(truth.battery_voltage_v / cells * 1e3)
    return dialect.MAVLink_battery_status_message(
        0, _BATTERY_ALL, _BATTERY_LIPO, 32767, [each] * cells + [65535] * (10 - cells),
        int16(truth.battery_current_a * 100.0), clip(s.consumed_mah, 0, 2**31 - 1), -1,
        clip(truth.battery_remaining * 100.0, 0, 100), 0, _CHARGE_OK,
    )  # fmt: skip


def home_position(s: Snapshot) -> Any | None:
    """Return HOME_POSITION once it is known."""
    if not s.commander.has_gps_fix:
        return None
    north, east, down = s.home_ned_m.tolist()
    return dialect.MAVLink_home_position_message(
        *s.geodetic_e7(north, east), round(s.amsl_m(down) * 1e3), north, east, down,
        [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, s.stamp_us,
    )  # fmt: skip


def gps_global_origin(s: Snapshot) -> Any | None:
    """Return GPS_GLOBAL_ORIGIN once it is known."""
    if not s.commander.has_gps_fix:
        return None
    altitude_mm = round(s.origin.altitude_amsl_m * 1e3)
    return dialect.MAVLink_gps_global_origin_message(
        *s.geodetic_e7(0.0, 0.0), altitude_mm, s.stamp_us
    )


def autopilot_version(_: Snapshot) -> Any:
    """AUTOPILOT_VERSION."""
    return dialect.MAVLink_autopilot_version_message(
        _CAPABILITIES, _FLIGHT_VERSION, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, _UNIQUE_ID
    )


def system_time(s: Snapshot) -> Any:
    """SYSTEM_TIME."""
    unix_us = UNIX_EPOCH_S * 1_000_000 + s.stamp_us
    return dialect.MAVLink_system_time_message(unix_us, s.boot_ms)


def timesync_request(s: Snapshot) -> Any:
    """Return TIMESYNC, which requests the peer's time."""
    return dialect.MAVLink_timesync_message(0, s.stamp_us * 1000)


def ping_request(s: Snapshot) -> Any:
    """Return PING, which requests an echo from every peer."""
    return dialect.MAVLink_ping_message(s.stamp_us, s.stamp_us // 1_000_000 & 0xFFFFFFFF, 0, 0)


def mission_current(_: Snapshot) -> Any:
    """Return MISSION_CURRENT without a mission."""
    return dialect.MAVLink_mission_current_message(0, 0, _MISSION_NO_MISSION, 0)


def estimator_status(s: Snapshot) -> Any:
    """ESTIMATOR_STATUS."""
    good = s.commander.has_global_position
    flags = _ESTIMATOR_GOOD if good else _ESTIMATOR_NO_POSITION
    return dialect.MAVLink_estimator_status_message(
        s.stamp_us, flags, 0.01, 0.01, 0.01, 0.01, 0.0, 0.0, 0.1, 0.1
    )


def vibration(s: Snapshot) -> Any:
    """Return VIBRATION with zeros, as vibration is not simulated."""
    return dialect.MAVLink_vibration_message(s.stamp_us, 0.0, 0.0, 0.0, 0, 0, 0)


def consumed_mah(current_a: float, elapsed_s: float) -> float:
    """Return the consumed charge, mAh."""
    return max(current_a, 0.0) * elapsed_s / 3.6
