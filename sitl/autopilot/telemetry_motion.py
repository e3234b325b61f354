"""Telemetry of position and motion."""

from __future__ import annotations

import math
from typing import Any

from mavfi_cli.link.codec import dialect
from sitl.autopilot.snapshot import Snapshot, int16, int32, uint16

_ZERO_MASKS = ((0, 0x007), (3, 0x038))
_LOCAL_NED = 1
_BODY_FRD = 12
_UNKNOWN_COVARIANCE = [math.nan] + [0.0] * 20
_ESTIMATOR_AUTOPILOT = 8
_STANDARD_PRESSURE_HPA = 1013.25
_GRAVITY_MPS2 = 9.80665


def local_position_ned(s: Snapshot) -> Any:
    """LOCAL_POSITION_NED."""
    x, y, z = s.truth.position_ned_m.tolist()
    vx, vy, vz = s.truth.velocity_ned_mps.tolist()
    return dialect.MAVLink_local_position_ned_message(s.boot_ms, x, y, z, vx, vy, vz)


def attitude(s: Snapshot) -> Any:
    """ATTITUDE."""
    return dialect.MAVLink_attitude_message(
        s.boot_ms, *s.euler_rad, *s.truth.rates_frd_radps.tolist()
    )


def attitude_quaternion(s: Snapshot) -> Any:
    """ATTITUDE_QUATERNION."""
    w, x, y, z = s.truth.quaternion_frd_ned.tolist()
    p, q, r = s.truth.rates_frd_radps.tolist()
    return dialect.MAVLink_attitude_quaternion_message(s.boot_ms, w, x, y, z, p, q, r)


def global_position_int(s: Snapshot) -> Any | None:
    """Return GLOBAL_POSITION_INT once the estimator has a global position."""
    if not s.commander.has_global_position:
        return None
    north, east, down = s.truth.position_ned_m.tolist()
    velocity = [int16(v * 100.0) for v in s.truth.velocity_ned_mps.tolist()]
    return dialect.MAVLink_global_position_int_message(
        s.boot_ms, *s.geodetic_e7(north, east), int32(s.amsl_m(down) * 1e3),
        int32((float(s.home_ned_m[2]) - down) * 1e3), *velocity, uint16(s.heading_deg * 100.0),
    )  # fmt: skip


def gps_raw_int(s: Snapshot) -> Any:
    """Return GPS_RAW_INT: no fix at first, then a good one."""
    north, east, down = s.truth.position_ned_m.tolist()
    vn, ve, _ = s.truth.velocity_ned_mps.tolist()
    if not s.commander.has_gps_fix:
        return dialect.MAVLink_gps_raw_int_message(s.stamp_us, 0, 0, 0, 0, 9999, 9999, 0, 0, 0)
    altitude_mm = int32(s.amsl_m(down) * 1e3)
    course = math.degrees(math.atan2(ve, vn)) % 360.0
    return dialect.MAVLink_gps_raw_int_message(
        s.stamp_us, 3, *s.geodetic_e7(north, east), altitude_mm, 90, 91,
        uint16(math.hypot(vn, ve) * 100.0), uint16(course * 100.0), 10, altitude_mm, 900, 1780,
        250, 0, 0,
    )  # fmt: skip


def vfr_hud(s: Snapshot) -> Any:
    """VFR_HUD."""
    vn, ve, vd = s.truth.velocity_ned_mps.tolist()
    commands = s.truth.motor_commands.tolist()
    throttle = 100.0 * sum(commands) / len(commands)
    speed = math.hypot(vn, ve)
    return dialect.MAVLink_vfr_hud_message(
        speed, speed, int16(s.heading_deg), uint16(throttle),
        s.amsl_m(float(s.truth.position_ned_m[2])), -vd,
    )  # fmt: skip


def altitude(s: Snapshot) -> Any:
    """Return ALTITUDE. The ground is flat at the origin's height."""
    down = float(s.truth.position_ned_m[2])
    amsl = s.amsl_m(down)
    return dialect.MAVLink_altitude_message(
        s.stamp_us, amsl, amsl, -down, float(s.home_ned_m[2]) - down,
        s.origin.altitude_amsl_m, -down,
    )  # fmt: skip


def odometry(s: Snapshot) -> Any:
    """Return ODOMETRY: pose in local NED, velocity in the body's FRD."""
    w, x, y, z = quaternion = s.truth.quaternion_frd_ned.tolist()
    vn, ve, vd = s.truth.velocity_ned_mps.tolist()
    forward = (1 - 2 * (y * y + z * z)) * vn + 2 * (x * y + w * z) * ve + 2 * (x * z - w * y) * vd
    right = 2 * (x * y - w * z) * vn + (1 - 2 * (x * x + z * z)) * ve + 2 * (y * z + w * x) * vd
    below = 2 * (x * z + w * y) * vn + 2 * (y * z - w * x) * ve + (1 - 2 * (x * x + y * y)) * vd
    return dialect.MAVLink_odometry_message(
        s.stamp_us, _LOCAL_NED, _BODY_FRD, *s.truth.position_ned_m.tolist(), quaternion,
        forward, right, below, *s.truth.rates_frd_radps.tolist(),
        _UNKNOWN_COVARIANCE, _UNKNOWN_COVARIANCE, 0, _ESTIMATOR_AUTOPILOT, 100,
    )  # fmt: skip


def highres_imu(s: Snapshot) -> Any:
    """Return HIGHRES_IMU: specific force and rates in FRD, without a magnetometer."""
    w, x, y, z = s.truth.quaternion_frd_ned.tolist()
    an, ae, ad = s.truth.acceleration_ned_mps2.tolist()
    ad -= _GRAVITY_MPS2
    force = (
        (1 - 2 * (y * y + z * z)) * an + 2 * (x * y + w * z) * ae + 2 * (x * z - w * y) * ad,
        2 * (x * y - w * z) * an + (1 - 2 * (x * x + z * z)) * ae + 2 * (y * z + w * x) * ad,
        2 * (x * z + w * y) * an + 2 * (y * z - w * x) * ae + (1 - 2 * (x * x + y * y)) * ad,
    )
    height = s.amsl_m(float(s.truth.position_ned_m[2]))
    ratio = max(1.0 - 2.25577e-5 * height, 0.0)  # ISA troposphere
    return dialect.MAVLink_highres_imu_message(
        s.stamp_us, *force, *s.truth.rates_frd_radps.tolist(), 0.0, 0.0, 0.0,
        _STANDARD_PRESSURE_HPA * ratio**5.25588, 0.0, height, 25.0, 0x1A3F & ~0x1C0,
    )  # fmt: skip


def position_target_local_ned(s: Snapshot) -> Any:
    """Return POSITION_TARGET_LOCAL_NED: the active setpoint, as in PX4."""
    values = s.setpoint.tolist()
    mask = sum(
        bits for start, bits in _ZERO_MASKS if all(map(math.isnan, values[start : start + 3]))
    )
    sent = [0.0 if math.isnan(value) else value for value in values]
    if math.isnan(values[9]):
        sent[9] = s.euler_rad[2]
    return dialect.MAVLink_position_target_local_ned_message(s.boot_ms, _LOCAL_NED, mask, *sent)


def attitude_target(s: Snapshot) -> Any:
    """Return ATTITUDE_TARGET: the present attitude and the mean motor command as thrust."""
    commands = s.truth.motor_commands.tolist()
    return dialect.MAVLink_attitude_target_message(
        s.boot_ms, 0, s.truth.quaternion_frd_ned.tolist(), *s.truth.rates_frd_radps.tolist(),
        sum(commands) / len(commands),
    )  # fmt: skip


def servo_output_raw(s: Snapshot) -> Any:
    """Return SERVO_OUTPUT_RAW: motor commands of 1000 to 2000 us, 900 if stopped, as in PX4."""
    pulses = [
        uint16(1000.0 + 1000.0 * command) if s.motors_on else 900
        for command in s.truth.motor_commands.tolist()
    ]
    return dialect.MAVLink_servo_output_raw_message(
        s.stamp_us & 0xFFFFFFFF, 0, *pulses[:4], *([0] * (8 - len(pulses[:4])))
    )
