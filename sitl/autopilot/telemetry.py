"""Telemetry: the state behind it, and one builder for each message.

Most messages can be streamed. Those of DESCRIPTIONS, what the autopilot is and can do, are sent on
request only.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mavfi_cli.core.frames import Vector
from mavfi_cli.link.added_messages import (
    AvailableModes,
    ComponentInformation,
    ComponentMetadata,
    ProtocolVersion,
)
from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import Commander, FlightMode
from sitl.autopilot.parameters import Parameters
from sitl.autopilot.setpoint import Setpoint, no_setpoint
from sitl.geodesy import Origin
from sitl.vehicle.vehicle import Truth

UNIX_EPOCH_S = 1_750_000_000  # Unix time of boot; fixed, so that runs are repeatable


@dataclass(slots=True, kw_only=True)
class Snapshot:
    """State behind every telemetry message. The autopilot updates it each tick."""

    commander: Commander
    parameters: Parameters
    origin: Origin
    truth: Truth
    home_ned_m: Vector  # (3,)
    stamp_us: int = 0
    setpoint: Setpoint = field(default_factory=no_setpoint)
    motors_on: bool = False
    offboard: Setpoint = field(default_factory=no_setpoint)  # newest one of the companion
    sticks: tuple[int, int, int, int] = (0, 0, 500, 0)  # newest x, y, z, r of MANUAL_CONTROL
    elapsed_s: float = 0.0  # since the tick before
    consumed_mah: float = 0.0

    @property
    def spooled_up(self) -> bool:
        """True once an armed vehicle's motors turn fast enough to take off."""
        return self.commander.armed_for_s >= self.parameters.effective("COM_SPOOLUP_TIME")

    @property
    def boot_ms(self) -> int:
        """Boot clock, ms, with 32-bit wrap-around."""
        return self.stamp_us // 1000 & 0xFFFFFFFF

    @property
    def heading_deg(self) -> float:
        """Heading from north, 0 to 360 degrees."""
        return math.degrees(self.truth.euler_rad[2]) % 360.0

    def geodetic_e7(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Return latitude and longitude of a local point, 1e-7 degrees."""
        latitude, longitude = self.origin.geodetic(north_m, east_m)
        return round(latitude * 1e7), round(longitude * 1e7)

    def amsl_m(self, down_m: float) -> float:
        """Return the altitude above sea level of a local height, m."""
        return self.origin.altitude_amsl_m - down_m


def _clip(value: float, low: int, high: int) -> int:
    """Return the nearest integer within the limits; 0 for NaN."""
    if math.isnan(value):
        return 0
    return round(min(max(value, low), high))


def _int16(value: float) -> int:
    return _clip(value, -32768, 32767)


def _uint16(value: float) -> int:
    """Clip a value for a uint16 field in which 65535 means unknown."""
    return _clip(value, 0, 65534)


def int32(value: float) -> int:
    """Clip a value for an int32 field."""
    return _clip(value, -(2**31), 2**31 - 1)


_ZERO_MASKS = ((0, 0x007), (3, 0x038))
_UNKNOWN_COVARIANCE = [math.nan] + [0.0] * 20
_STANDARD_PRESSURE_HPA = 1013.25
_GRAVITY_MPS2 = 9.80665


def _local_position_ned(s: Snapshot) -> Any:
    x, y, z = s.truth.position_ned_m.tolist()
    vx, vy, vz = s.truth.velocity_ned_mps.tolist()
    return dialect.MAVLink_local_position_ned_message(s.boot_ms, x, y, z, vx, vy, vz)


def _attitude(s: Snapshot) -> Any:
    return dialect.MAVLink_attitude_message(
        s.boot_ms, *s.truth.euler_rad, *s.truth.rates_frd_radps.tolist()
    )


def _attitude_quaternion(s: Snapshot) -> Any:
    w, x, y, z = s.truth.quaternion_frd_ned.tolist()
    p, q, r = s.truth.rates_frd_radps.tolist()
    return dialect.MAVLink_attitude_quaternion_message(s.boot_ms, w, x, y, z, p, q, r)


def _global_position_int(s: Snapshot) -> Any | None:
    """Return GLOBAL_POSITION_INT once the estimator has a global position."""
    if not s.commander.has_global_position:
        return None
    north, east, down = s.truth.position_ned_m.tolist()
    velocity = [_int16(v * 100.0) for v in s.truth.velocity_ned_mps.tolist()]
    return dialect.MAVLink_global_position_int_message(
        s.boot_ms, *s.geodetic_e7(north, east), int32(s.amsl_m(down) * 1e3),
        int32((float(s.home_ned_m[2]) - down) * 1e3), *velocity, _uint16(s.heading_deg * 100.0),
    )  # fmt: skip


def _gps_raw_int(s: Snapshot) -> Any:
    """Return GPS_RAW_INT: no fix at first, then a good one."""
    north, east, down = s.truth.position_ned_m.tolist()
    vn, ve, _ = s.truth.velocity_ned_mps.tolist()
    if not s.commander.has_gps_fix:
        return dialect.MAVLink_gps_raw_int_message(s.stamp_us, 0, 0, 0, 0, 9999, 9999, 0, 0, 0)
    altitude_mm = int32(s.amsl_m(down) * 1e3)
    course = math.degrees(math.atan2(ve, vn)) % 360.0
    return dialect.MAVLink_gps_raw_int_message(
        s.stamp_us, 3, *s.geodetic_e7(north, east), altitude_mm, 90, 91,
        _uint16(math.hypot(vn, ve) * 100.0), _uint16(course * 100.0), 10, altitude_mm, 900, 1780,
        250, 0, 0,
    )  # fmt: skip


def _thrust(s: Snapshot) -> float:
    """Mean motor command, added one by one: `sum` rounds floats otherwise from Python 3.12 on."""
    commands = s.truth.motor_commands.tolist()
    return float(functools.reduce(operator.add, commands)) / len(commands)


def _vfr_hud(s: Snapshot) -> Any:
    vn, ve, vd = s.truth.velocity_ned_mps.tolist()
    throttle = 100.0 * _thrust(s)
    speed = math.hypot(vn, ve)
    return dialect.MAVLink_vfr_hud_message(
        speed, speed, _int16(s.heading_deg), _uint16(throttle),
        s.amsl_m(float(s.truth.position_ned_m[2])), -vd,
    )  # fmt: skip


def _altitude(s: Snapshot) -> Any:
    """Return ALTITUDE. The ground is flat at the origin's height."""
    down = float(s.truth.position_ned_m[2])
    amsl = s.amsl_m(down)
    return dialect.MAVLink_altitude_message(
        s.stamp_us, amsl, amsl, -down, float(s.home_ned_m[2]) - down,
        s.origin.altitude_amsl_m, -down,
    )  # fmt: skip


def _in_body(quaternion: list[float], vector_ned: list[float]) -> tuple[float, float, float]:
    """Turn a vector from NED into the body's FRD."""
    w, x, y, z = quaternion
    n, e, d = vector_ned
    return (
        (1 - 2 * (y * y + z * z)) * n + 2 * (x * y + w * z) * e + 2 * (x * z - w * y) * d,
        2 * (x * y - w * z) * n + (1 - 2 * (x * x + z * z)) * e + 2 * (y * z + w * x) * d,
        2 * (x * z + w * y) * n + 2 * (y * z - w * x) * e + (1 - 2 * (x * x + y * y)) * d,
    )


def _odometry(s: Snapshot) -> Any:
    """Return ODOMETRY: pose in local NED, velocity in the body's FRD."""
    quaternion = s.truth.quaternion_frd_ned.tolist()
    return dialect.MAVLink_odometry_message(
        s.stamp_us, dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD,
        *s.truth.position_ned_m.tolist(), quaternion,
        *_in_body(quaternion, s.truth.velocity_ned_mps.tolist()),
        *s.truth.rates_frd_radps.tolist(),
        _UNKNOWN_COVARIANCE, _UNKNOWN_COVARIANCE, 0, dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT, 100,
    )  # fmt: skip


def _highres_imu(s: Snapshot) -> Any:
    """Return HIGHRES_IMU: specific force and rates in FRD, without a magnetometer."""
    north, east, down = s.truth.acceleration_ned_mps2.tolist()
    force = _in_body(s.truth.quaternion_frd_ned.tolist(), [north, east, down - _GRAVITY_MPS2])
    height = s.amsl_m(float(s.truth.position_ned_m[2]))
    ratio = max(1.0 - 2.25577e-5 * height, 0.0)  # ISA troposphere
    return dialect.MAVLink_highres_imu_message(
        s.stamp_us, *force, *s.truth.rates_frd_radps.tolist(), 0.0, 0.0, 0.0,
        _STANDARD_PRESSURE_HPA * ratio**5.25588, 0.0, height, 25.0, 0x1A3F & ~0x1C0,
    )  # fmt: skip


def _position_target_local_ned(s: Snapshot) -> Any:
    """Return POSITION_TARGET_LOCAL_NED: the active setpoint, as in PX4."""
    values = s.setpoint.tolist()
    mask = sum(
        bits for start, bits in _ZERO_MASKS if all(map(math.isnan, values[start : start + 3]))
    )
    sent = [0.0 if math.isnan(value) else value for value in values]
    if math.isnan(values[9]):
        sent[9] = s.truth.euler_rad[2]
    return dialect.MAVLink_position_target_local_ned_message(
        s.boot_ms, dialect.MAV_FRAME_LOCAL_NED, mask, *sent
    )


def _attitude_target(s: Snapshot) -> Any:
    """Return ATTITUDE_TARGET: the present attitude and the mean motor command as thrust."""
    return dialect.MAVLink_attitude_target_message(
        s.boot_ms, 0, s.truth.quaternion_frd_ned.tolist(), *s.truth.rates_frd_radps.tolist(),
        _thrust(s),
    )  # fmt: skip


def _servo_output_raw(s: Snapshot) -> Any:
    """Return SERVO_OUTPUT_RAW: motor commands of 1000 to 2000 us, 900 if stopped, as in PX4."""
    pulses = [
        _uint16(1000.0 + 1000.0 * command) if s.motors_on else 900
        for command in s.truth.motor_commands.tolist()
    ]
    return dialect.MAVLink_servo_output_raw_message(
        s.stamp_us & 0xFFFFFFFF, 0, *pulses[:4], *([0] * (8 - len(pulses[:4])))
    )


_GPS = dialect.MAV_SYS_STATUS_SENSOR_GPS
_PRESENT = 0x0300402F  # as in PX4 v1.17 SITL
_ENABLED = 0x0301402F
_HEALTH = 0x0320C83F

_CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
_FLIGHT_VERSION = 0x011100FF  # 1.17.0 official
_UNIQUE_ID = 0x4D41564649  # "MAVFI"

_ESTIMATOR_GOOD = 0x33F
_ESTIMATOR_NO_POSITION = 0x027


def _heartbeat(s: Snapshot) -> Any:
    commander = s.commander
    mode = commander.mode
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_PX4,
        mode.base_mode(armed=commander.armed), mode.custom_mode, commander.system_status, 3,
    )  # fmt: skip


def _sys_status(s: Snapshot) -> Any:
    """Return SYS_STATUS. PREARM_CHECK appears in the health bits only, as in PX4."""
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


def _extended_sys_state(s: Snapshot) -> Any:
    return dialect.MAVLink_extended_sys_state_message(0, s.commander.landed_state)


def _battery_status(s: Snapshot) -> Any:
    """Return BATTERY_STATUS with equal cell voltages."""
    truth = s.truth
    cells = min(max(int(s.parameters.value("BAT1_N_CELLS")), 1), 10)
    each = _uint16(truth.battery_voltage_v / cells * 1e3)
    return dialect.MAVLink_battery_status_message(
        0, dialect.MAV_BATTERY_FUNCTION_ALL, dialect.MAV_BATTERY_TYPE_LIPO, 32767,
        [each] * cells + [65535] * (10 - cells),
        _int16(truth.battery_current_a * 100.0), _clip(s.consumed_mah, 0, 2**31 - 1), -1,
        _clip(truth.battery_remaining * 100.0, 0, 100), 0, dialect.MAV_BATTERY_CHARGE_STATE_OK,
    )  # fmt: skip


def _home_position(s: Snapshot) -> Any | None:
    """Return HOME_POSITION once it is known."""
    if not s.commander.has_gps_fix:
        return None
    north, east, down = s.home_ned_m.tolist()
    return dialect.MAVLink_home_position_message(
        *s.geodetic_e7(north, east), round(s.amsl_m(down) * 1e3), north, east, down,
        [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, s.stamp_us,
    )  # fmt: skip


def _gps_global_origin(s: Snapshot) -> Any | None:
    if not s.commander.has_gps_fix:
        return None
    altitude_mm = round(s.origin.altitude_amsl_m * 1e3)
    return dialect.MAVLink_gps_global_origin_message(
        *s.geodetic_e7(0.0, 0.0), altitude_mm, s.stamp_us
    )


def _autopilot_version(_: Snapshot) -> Any:
    return dialect.MAVLink_autopilot_version_message(
        _CAPABILITIES, _FLIGHT_VERSION, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, _UNIQUE_ID
    )


def _system_time(s: Snapshot) -> Any:
    unix_us = UNIX_EPOCH_S * 1_000_000 + s.stamp_us
    return dialect.MAVLink_system_time_message(unix_us, s.boot_ms)


def _timesync(s: Snapshot) -> Any:
    """Return TIMESYNC, which requests the peer's time."""
    return dialect.MAVLink_timesync_message(0, s.stamp_us * 1000)


def _ping(s: Snapshot) -> Any:
    """Return PING, which requests an echo from every peer."""
    return dialect.MAVLink_ping_message(s.stamp_us, s.stamp_us // 1_000_000 & 0xFFFFFFFF, 0, 0)


def _mission_current(_: Snapshot) -> Any:
    return dialect.MAVLink_mission_current_message(0, 0, dialect.MISSION_STATE_NO_MISSION, 0)


def _estimator_status(s: Snapshot) -> Any:
    good = s.commander.has_global_position
    flags = _ESTIMATOR_GOOD if good else _ESTIMATOR_NO_POSITION
    return dialect.MAVLink_estimator_status_message(
        s.stamp_us, flags, 0.01, 0.01, 0.01, 0.01, 0.0, 0.0, 0.1, 0.1
    )


def _vibration(s: Snapshot) -> Any:
    return dialect.MAVLink_vibration_message(s.stamp_us, 0.0, 0.0, 0.0, 0, 0, 0)


Builder = Callable[[Snapshot], Any]

# LOCAL_POSITION_NED is the last, because it ends the tick's batch on a lockstep link.
_IN_ORDER: tuple[Builder, ...] = (
    _heartbeat, _sys_status, _system_time, _ping, _gps_raw_int, _attitude,
    _global_position_int, _servo_output_raw, _mission_current, _gps_global_origin, _vfr_hud,
    _attitude_target, _position_target_local_ned, _highres_imu, _timesync, _altitude,
    _battery_status, _autopilot_version, _estimator_status, _vibration, _home_position,
    _extended_sys_state, _odometry, _attitude_quaternion, _local_position_ned,
)  # fmt: skip

BUILDERS: Mapping[int, Builder] = {
    getattr(dialect, f"MAVLINK_MSG_ID{build.__name__.upper()}"): build for build in _IN_ORDER
}
"""Builders by message id, of every message that can be streamed or requested, in sending order.

A builder returns None while its message has no contents.
"""


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
