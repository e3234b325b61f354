"""Builds telemetry messages, and schedules the streams of each client.

Most messages can be streamed. The messages in DESCRIPTIONS, which describe the autopilot, are sent
only on request.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.config import read_toml
from mavfi_cli.link.codec import AvailableModes, ComponentMetadata, ProtocolVersion, dialect
from sitl.autopilot.commander import FlightMode, Snapshot
from sitl.geodesy import standard_pressure_pa
from sitl.vehicle.cascade import SP_THRUST
from sitl.vehicle.profile import GRAVITY_MPS2

TICK_US = 20_000  # period of the control loop
STEPS_A_TICK = 5
STEP_US = TICK_US // STEPS_A_TICK  # step of the physics, the shortest interval of any stream
_OUTBOX = 500  # maximum messages queued for a client; the oldest are dropped first
_UNIX_EPOCH_S = 1_750_000_000  # Unix time of boot; fixed, so that runs are repeatable


def _clip(value: float, low: int, high: int) -> int:
    """Return the integer within the limits that is nearest to a value, or 0 if it is NaN."""
    return 0 if math.isnan(value) else round(min(max(value, low), high))


def _int16(value: float) -> int:
    return _clip(value, -32768, 32767)


def _uint16(value: float) -> int:
    """Round a value and clip it for a uint16 field in which 65535 means unknown."""
    return _clip(value, 0, 65534)


def int32(value: float) -> int:
    """Round a value and clip it for an int32 field. NaN becomes 0."""
    return _clip(value, -(2**31), 2**31 - 1)


# Messages -----------------------------------------------------------------------------------------

_GPS = dialect.MAV_SYS_STATUS_SENSOR_GPS
_PRESENT = 0x0300402F  # as in PX4 v1.17 SITL
_ENABLED = 0x0301402F
_HEALTH = 0x0320C83F
_CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
_FLIGHT_VERSION = 0x011100FF  # 1.17.0 official
_UNIQUE_ID = 0x4D41564649  # "MAVFI"
_ESTIMATOR_GOOD, _ESTIMATOR_NO_POSITION = 0x33F, 0x027
_ZERO_MASKS = ((0, 0x007), (3, 0x038))
_UNKNOWN_COVARIANCE = [math.nan] + [0.0] * 20


def _heartbeat(s: Snapshot) -> Any:
    commander, mode = s.commander, s.commander.mode
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_PX4,
        mode.base_mode(armed=commander.armed), mode.custom_mode, commander.system_status, 3,
    )  # fmt: skip


def _sys_status(s: Snapshot) -> Any:
    """Return SYS_STATUS. As in PX4, PREARM_CHECK appears only in the health bits."""
    gps = _GPS if s.commander.has_gps_fix else 0
    health = _HEALTH & ~_GPS | gps
    if s.commander.can_arm:
        health |= dialect.MAV_SYS_STATUS_PREARM_CHECK
    truth = s.truth
    return dialect.MAVLink_sys_status_message(
        _PRESENT & ~_GPS | gps, _ENABLED, health, 250, _uint16(truth.battery_voltage_v * 1e3),
        _int16(truth.battery_current_a * 100.0), _clip(truth.battery_remaining * 100.0, 0, 100),
        0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def _gps_raw_int(s: Snapshot) -> Any:
    """Return GPS_RAW_INT: without a fix shortly after boot, then with a good fix."""
    if not s.commander.has_gps_fix:
        return dialect.MAVLink_gps_raw_int_message(s.stamp_us, 0, 0, 0, 0, 9999, 9999, 0, 0, 0)
    north, east, down = s.truth.position_ned_m.tolist()
    vn, ve, _ = s.truth.velocity_ned_mps.tolist()
    altitude_mm = int32(s.amsl_m(down) * 1e3)
    course = math.degrees(math.atan2(ve, vn)) % 360.0
    return dialect.MAVLink_gps_raw_int_message(
        s.stamp_us, 3, *s.geodetic_e7(north, east), altitude_mm, 90, 91,
        _uint16(math.hypot(vn, ve) * 100.0), _uint16(course * 100.0), 10, altitude_mm, 900, 1780,
        250, 0, 0,
    )  # fmt: skip


def _global_position_int(s: Snapshot) -> Any | None:
    if not s.commander.has_global_position:
        return None
    north, east, down = s.truth.position_ned_m.tolist()
    velocity = [_int16(v * 100.0) for v in s.truth.velocity_ned_mps.tolist()]
    return dialect.MAVLink_global_position_int_message(
        s.boot_ms, *s.geodetic_e7(north, east), int32(s.amsl_m(down) * 1e3),
        int32((float(s.home_ned_m[2]) - down) * 1e3), *velocity, _uint16(s.heading_deg * 100.0),
    )  # fmt: skip


def _servo_output_raw(s: Snapshot) -> Any:
    """Return SERVO_OUTPUT_RAW: pulses of 1000 to 2000 us, or 900 us with motors off, as in PX4."""
    commands = s.truth.motor_commands.tolist()
    pulses = [_uint16(1000.0 + 1000.0 * c) if s.motors_on else 900 for c in commands]
    stamp_us = s.stamp_us & 0xFFFFFFFF
    return dialect.MAVLink_servo_output_raw_message(stamp_us, 0, *pulses, 0, 0, 0, 0)


def _gps_global_origin(s: Snapshot) -> Any | None:
    if not s.commander.has_gps_fix:
        return None
    place = *s.geodetic_e7(0.0, 0.0), round(s.origin.altitude_amsl_m * 1e3)
    return dialect.MAVLink_gps_global_origin_message(*place, s.stamp_us)


def _vfr_hud(s: Snapshot) -> Any:
    vn, ve, vd = s.truth.velocity_ned_mps.tolist()
    speed = math.hypot(vn, ve)
    return dialect.MAVLink_vfr_hud_message(
        speed, speed, _int16(s.heading_deg), _uint16(100.0 * s.thrust),
        s.amsl_m(float(s.truth.position_ned_m[2])), -vd,
    )  # fmt: skip


def _attitude_target(s: Snapshot) -> Any:
    quaternion, rates = s.truth.quaternion_frd_ned.tolist(), s.truth.rates_frd_radps.tolist()
    return dialect.MAVLink_attitude_target_message(s.boot_ms, 0, quaternion, *rates, s.thrust)


def _position_target_local_ned(s: Snapshot) -> Any:
    """Return POSITION_TARGET_LOCAL_NED with the active setpoint, as in PX4."""
    unset = np.isnan(s.setpoint)
    mask = sum(bits for start, bits in _ZERO_MASKS if unset[start : start + 3].all())
    sent = np.where(unset, 0.0, s.setpoint).tolist()[:SP_THRUST]
    if unset[9]:
        sent[9] = s.truth.euler_rad[2]
    return dialect.MAVLink_position_target_local_ned_message(
        s.boot_ms, dialect.MAV_FRAME_LOCAL_NED, mask, *sent
    )


def _highres_imu(s: Snapshot) -> Any:
    """Return HIGHRES_IMU: specific force and rates in FRD, and pressure; no magnetometer."""
    force_ned = s.truth.acceleration_ned_mps2 - np.array([0.0, 0.0, GRAVITY_MPS2])
    height = s.amsl_m(float(s.truth.position_ned_m[2]))
    return dialect.MAVLink_highres_imu_message(
        s.stamp_us, *s.truth.in_body(force_ned).tolist(),
        *s.truth.rates_frd_radps.tolist(), 0.0, 0.0, 0.0, standard_pressure_pa(height) / 100.0,
        0.0, height, 25.0, 0x1A3F & ~0x1C0,
    )  # fmt: skip


def _altitude(s: Snapshot) -> Any:
    """Return ALTITUDE: above the sea, home and the ground, which is flat at the origin's height."""
    down = float(s.truth.position_ned_m[2])
    amsl, above_home = s.amsl_m(down), float(s.home_ned_m[2]) - down
    return dialect.MAVLink_altitude_message(
        s.stamp_us, amsl, amsl, -down, above_home, s.origin.altitude_amsl_m, -down
    )


def _battery_status(s: Snapshot) -> Any:
    truth = s.truth
    cells = min(max(int(s.parameters.value("BAT1_N_CELLS")), 1), 10)
    cell_mv = _uint16(truth.battery_voltage_v / cells * 1e3)
    return dialect.MAVLink_battery_status_message(
        0, dialect.MAV_BATTERY_FUNCTION_ALL, dialect.MAV_BATTERY_TYPE_LIPO, 32767,
        [cell_mv] * cells + [65535] * (10 - cells),
        _int16(truth.battery_current_a * 100.0), _clip(s.consumed_mah, 0, 2**31 - 1), -1,
        _clip(truth.battery_remaining * 100.0, 0, 100), 0, dialect.MAV_BATTERY_CHARGE_STATE_OK,
    )  # fmt: skip


def _estimator_status(s: Snapshot) -> Any:
    flags = _ESTIMATOR_GOOD if s.commander.has_global_position else _ESTIMATOR_NO_POSITION
    return dialect.MAVLink_estimator_status_message(
        s.stamp_us, flags, 0.01, 0.01, 0.01, 0.01, 0.0, 0.0, 0.1, 0.1
    )


def _home_position(s: Snapshot) -> Any | None:
    if not s.commander.has_gps_fix:
        return None
    north, east, down = s.home_ned_m.tolist()
    return dialect.MAVLink_home_position_message(
        *s.geodetic_e7(north, east), round(s.amsl_m(down) * 1e3), north, east, down,
        [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, s.stamp_us,
    )  # fmt: skip


def _odometry(s: Snapshot) -> Any:
    """Return ODOMETRY: the pose in local NED, the velocity in body FRD."""
    truth = s.truth
    return dialect.MAVLink_odometry_message(
        s.stamp_us, dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD,
        *truth.position_ned_m.tolist(), truth.quaternion_frd_ned.tolist(),
        *truth.in_body(truth.velocity_ned_mps).tolist(), *truth.rates_frd_radps.tolist(),
        _UNKNOWN_COVARIANCE, _UNKNOWN_COVARIANCE, 0, dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT, 100,
    )  # fmt: skip


_Builder = Callable[[Snapshot], Any]

# LOCAL_POSITION_NED comes last, because it ends the tick's batch on a lockstep link.
BUILDERS: Mapping[int, _Builder] = {
    dialect.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: _sys_status,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME: lambda s: dialect.MAVLink_system_time_message(
        _UNIX_EPOCH_S * 1_000_000 + s.stamp_us, s.boot_ms
    ),
    dialect.MAVLINK_MSG_ID_PING: lambda s: dialect.MAVLink_ping_message(  # asks for an echo
        s.stamp_us, s.stamp_us // 1_000_000 & 0xFFFFFFFF, 0, 0
    ),
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: _gps_raw_int,
    dialect.MAVLINK_MSG_ID_ATTITUDE: lambda s: dialect.MAVLink_attitude_message(
        s.boot_ms, *s.truth.euler_rad, *s.truth.rates_frd_radps.tolist()
    ),
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _global_position_int,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: _servo_output_raw,
    dialect.MAVLINK_MSG_ID_MISSION_CURRENT: lambda _: dialect.MAVLink_mission_current_message(
        0, 0, dialect.MISSION_STATE_NO_MISSION, 0
    ),
    dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _gps_global_origin,
    dialect.MAVLINK_MSG_ID_VFR_HUD: _vfr_hud,
    dialect.MAVLINK_MSG_ID_ATTITUDE_TARGET: _attitude_target,
    dialect.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: _position_target_local_ned,
    dialect.MAVLINK_MSG_ID_HIGHRES_IMU: _highres_imu,
    dialect.MAVLINK_MSG_ID_TIMESYNC: lambda s: dialect.MAVLink_timesync_message(
        0, s.stamp_us * 1000
    ),
    dialect.MAVLINK_MSG_ID_ALTITUDE: _altitude,
    dialect.MAVLINK_MSG_ID_BATTERY_STATUS: _battery_status,
    dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION: lambda _: dialect.MAVLink_autopilot_version_message(
        _CAPABILITIES, _FLIGHT_VERSION, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, _UNIQUE_ID
    ),
    dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator_status,
    dialect.MAVLINK_MSG_ID_VIBRATION: lambda s: dialect.MAVLink_vibration_message(
        s.stamp_us, 0.0, 0.0, 0.0, 0, 0, 0
    ),
    dialect.MAVLINK_MSG_ID_HOME_POSITION: _home_position,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: lambda s: dialect.MAVLink_extended_sys_state_message(
        0, s.commander.landed_state
    ),
    dialect.MAVLINK_MSG_ID_ODOMETRY: _odometry,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (
        lambda s: dialect.MAVLink_attitude_quaternion_message(
            s.boot_ms, *s.truth.quaternion_frd_ned.tolist(), *s.truth.rates_frd_radps.tolist()
        )
    ),
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (
        lambda s: dialect.MAVLink_local_position_ned_message(
            s.boot_ms, *s.truth.position_ned_m.tolist(), *s.truth.velocity_ned_mps.tolist()
        )
    ),
}
"""Builders of all messages that can be streamed or requested, by message id, in sending order.

A builder returns None while the contents of its message are unknown.
"""

_NOT_SELECTABLE = 2  # MAV_MODE_PROPERTY_NOT_USER_SELECTABLE
_STANDARD_MODES = {
    FlightMode.POSCTL: dialect.MAV_STANDARD_MODE_POSITION_HOLD,
    FlightMode.TAKEOFF: dialect.MAV_STANDARD_MODE_TAKEOFF,
    FlightMode.RTL: dialect.MAV_STANDARD_MODE_SAFE_RECOVERY,
    FlightMode.LAND: dialect.MAV_STANDARD_MODE_LAND,
}


def _flight_information(now: Snapshot, _index: int) -> list[Any]:
    """Return FLIGHT_INFORMATION; the time of arming is 0 while disarmed."""
    armed_us = 0
    if now.commander.armed:
        armed_us = _UNIX_EPOCH_S * 1_000_000 + now.stamp_us - round(now.commander.armed_for_s * 1e6)
    return [dialect.MAVLink_flight_information_message(now.boot_ms, armed_us, 0, 0)]


def _available_modes(_now: Snapshot, index: int) -> list[Any]:
    """Return the AVAILABLE_MODES message of the mode with an index, counted from 1.

    An index of 0 selects the messages of all modes.
    """
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
    ProtocolVersion.id: lambda _now, _index: [ProtocolVersion(200, 100, 200, [0] * 8, [0] * 8)],
    # There is no file, as there is no file transfer.
    ComponentMetadata.id: lambda now, _index: [ComponentMetadata(now.boot_ms, 0, b"")],
    AvailableModes.id: _available_modes,
}
"""Builders of the messages that describe the autopilot, by message id.

The second argument of a builder is param2 of the request.
"""


# Streams ------------------------------------------------------------------------------------------


class Preset(Enum):
    """Name of a set of default stream rates for a link. `streams.toml` has the rates."""

    ONBOARD = "onboard"  # PX4 v1.17's link to a companion
    GCS = "gcs"  # PX4 v1.17's link to a ground station
    LOCKSTEP = "lockstep"  # only the messages that a companion in lockstep needs


_RATES_HZ, _ = read_toml(Path(__file__).with_name("streams.toml"))


@dataclass(slots=True)
class _Stream:
    build: _Builder
    interval_us: int  # 0: not streamed
    due_us: int = 0


class Link:
    """The autopilot's end of one connection, without a socket, and its telemetry streams."""

    def __init__(self, preset: Preset) -> None:
        self.in_lockstep = preset is Preset.LOCKSTEP  # time stands still while the client computes
        self.outbox: list[Any] = []  # pending messages, oldest first
        self.parameters_left: deque[int] = deque()  # indices of parameters still to send
        self._rates_hz: Mapping[str, float] = _RATES_HZ[preset.value]
        self._streams = {
            number: _Stream(build, self._default_us(number)) for number, build in BUILDERS.items()
        }
        self._active: tuple[_Stream, ...] = ()
        self._fast: tuple[_Stream, ...] = ()
        self._choose_active()

    def send(self, message: Any) -> None:
        """Queue a message for this client. If the queue is full, drop the oldest message."""
        if len(self.outbox) >= _OUTBOX:
            del self.outbox[0]
        self.outbox.append(message)

    def take(self) -> list[Any]:
        """Return the pending messages and clear the queue."""
        messages, self.outbox = self.outbox, []
        return messages

    def interval_us(self, message_id: int) -> int | None:
        """Return the interval, us, at which a message is streamed.

        It is 0 if the message is not streamed, and None if its id is unknown.
        """
        stream = self._streams.get(message_id)
        return None if stream is None else stream.interval_us

    def set_interval(self, message_id: int, interval_us: float, stamp_us: int) -> bool:
        """Set the interval, us, at which a message is streamed. Return False if its id is unknown.

        A negative interval stops the stream, and 0 restores the preset's default. Other intervals
        are clipped to the range that the link supports.
        """
        stream = self._streams.get(message_id)
        if stream is None:
            return False
        if interval_us > 0:
            shortest_us = TICK_US if self.in_lockstep else STEP_US
            stream.interval_us = int(min(max(interval_us, shortest_us), 3.6e9))
        else:
            stream.interval_us = 0 if interval_us < 0 else self._default_us(message_id)
        stream.due_us = stamp_us
        self._choose_active()
        return True

    def hasten(self, message_id: int, stamp_us: int) -> None:
        """Make a streamed message due at a stamp, because its contents have changed."""
        self._streams[message_id].due_us = stamp_us

    @property
    def is_fast(self) -> bool:
        """True if a stream's interval is shorter than a tick."""
        return bool(self._fast)

    def due(self, snapshot: Snapshot, *, between_ticks: bool = False) -> list[Any]:
        """Return the messages of all streams that are due at the snapshot's stamp.

        With `between_ticks`, return only those of the fast streams. A late stream skips the
        messages that it missed.
        """
        stamp_us, messages = snapshot.stamp_us, []
        for stream in self._fast if between_ticks else self._active:
            if stream.due_us > stamp_us:
                continue
            stream.due_us += stream.interval_us
            if stream.due_us <= stamp_us:
                stream.due_us = stamp_us + stream.interval_us
            message = stream.build(snapshot)
            if message is not None:
                messages.append(message)
        return messages

    def _default_us(self, message_id: int) -> int:
        rate_hz = self._rates_hz.get(dialect.mavlink_map[message_id].msgname, 0.0)
        return round(1e6 / rate_hz) if rate_hz else 0

    def _choose_active(self) -> None:
        self._active = tuple(s for s in self._streams.values() if s.interval_us)
        self._fast = tuple(s for s in self._active if s.interval_us < TICK_US)


class Links:
    """The links of an autopilot, one for each client."""

    def __init__(self) -> None:
        self._links: list[Link] = []

    def open_link(self, preset: Preset) -> Link:
        """Add a client, and return its link with the streams of a preset."""
        self._links.append(Link(preset))
        return self._links[-1]

    def close_link(self, link: Link) -> None:
        """Remove the link of a client."""
        self._links.remove(link)

    def broadcast(self, message: Any) -> None:
        """Queue a message for every client."""
        for link in self._links:
            link.send(message)
