"""State reported by telemetry at one stamp."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from sitl.autopilot.commander import Commander
from sitl.autopilot.parameters import Parameters
from sitl.autopilot.setpoint import Setpoint, no_setpoint
from sitl.autopilot.truth import StateEstimate, Vector
from sitl.geodesy import Origin

UNIX_EPOCH_S = 1_750_000_000  # Unix time of boot; fixed, so that runs are repeatable


@dataclass(slots=True, kw_only=True)
class Snapshot:
    """State behind every telemetry message. The autopilot updates it each tick."""

    commander: Commander
    parameters: Parameters
    origin: Origin
    truth: StateEstimate
    home_ned_m: Vector  # (3,)
    stamp_us: int = 0
    setpoint: Setpoint = field(default_factory=no_setpoint)
    motors_on: bool = False
    consumed_mah: float = 0.0
    _euler: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _euler_us: int = -1

    @property
    def boot_ms(self) -> int:
        """Boot clock, ms, with 32-bit wrap-around."""
        return self.stamp_us // 1000 & 0xFFFFFFFF

    @property
    def euler_rad(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw from north, z-y-x; computed once per tick."""
        if self._euler_us != self.stamp_us:
            w, x, y, z = self.truth.quaternion_frd_ned.tolist()
            self._euler = (
                math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
                math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
                math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
            )
            self._euler_us = self.stamp_us
        return self._euler

    @property
    def heading_deg(self) -> float:
        """Heading from north, 0 to 360 degrees."""
        return math.degrees(self.euler_rad[2]) % 360.0

    def geodetic_e7(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Return latitude and longitude of a local point, 1e-7 degrees."""
        latitude, longitude = self.origin.geodetic(north_m, east_m)
        return round(latitude * 1e7), round(longitude * 1e7)

    def amsl_m(self, down_m: float) -> float:
        """Return the altitude above sea level of a local height, m."""
        return self.origin.altitude_amsl_m - down_m


def clip(value: float, low: int, high: int) -> int:
    """Return the nearest integer within the limits; 0 for NaN."""
    if math.isnan(value):
        return 0
    return round(min(max(value, low), high))


def int16(value: float) -> int:
    """Clip a value for an int16 field."""
    return clip(value, -32768, 32767)


def uint16(value: float) -> int:
    """Clip a value for a uint16 field in which 65535 means unknown."""
    return clip(value, 0, 65534)


def int32(value: float) -> int:
    """Clip a value for an int32 field."""
    return clip(value, -(2**31), 2**31 - 1)
