"""Builds SET_POSITION_TARGET_LOCAL_NED from velocity, yaw and acceleration in ENU."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mavfi_cli.core.frames import ned_yaw_from_enu
from mavfi_cli.link.codec import Message, dialect

_MASK_VELOCITY_YAW = (
    dialect.POSITION_TARGET_TYPEMASK_X_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_Z_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
)
_NO_ACCELERATION = (
    dialect.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AZ_IGNORE
)
_NO_YAW = dialect.POSITION_TARGET_TYPEMASK_YAW_IGNORE
_LARGEST_FLOAT32 = 3.4028234663852886e38
_FRAME = dialect.MAV_FRAME_LOCAL_NED

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A setpoint for the autopilot. The default holds position and heading."""

    velocity_enu_mps: Triple = (0.0, 0.0, 0.0)
    yaw_enu_rad: float | None = None  # None: keep the heading
    acceleration_enu_mps2: Triple | None = None  # feed-forward

    @property
    def type_mask(self) -> int:
        """Mask of the ignored fields: 2503 without feed-forward, 2055 with it."""
        mask: int = _MASK_VELOCITY_YAW
        if self.acceleration_enu_mps2 is None:
            mask |= _NO_ACCELERATION
        if self.yaw_enu_rad is None:
            mask |= _NO_YAW
        return mask

    def message(self, stamp_s: float, system: int, component: int) -> Message:
        """Return the message for one stamp.

        A value beyond float32 becomes infinity, as in a C++ companion, and NaN stays NaN. The
        autopilot decides how to handle a corrupted command.
        """
        east, north, up = (_float32(v) for v in self.velocity_enu_mps)
        ax, ay, az = 0.0, 0.0, 0.0
        if self.acceleration_enu_mps2 is not None:
            ay, ax, az = (_float32(v) for v in self.acceleration_enu_mps2)
        yaw = 0.0 if self.yaw_enu_rad is None else ned_yaw_from_enu(self.yaw_enu_rad)
        return dialect.MAVLink_set_position_target_local_ned_message(
            boot_ms(stamp_s), system, component, _FRAME, self.type_mask,
            0.0, 0.0, 0.0, north, east, -up, ax, ay, -az, yaw, 0.0,
        )  # fmt: skip


def boot_ms(stamp_s: float) -> int:
    """Convert a stamp to MAVLink's 32-bit milliseconds."""
    return round(stamp_s * 1e3) & 0xFFFF_FFFF


def _float32(value: float) -> float:
    number = float(value)
    if abs(number) > _LARGEST_FLOAT32:
        return math.copysign(math.inf, number)
    return number
