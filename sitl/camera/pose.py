"""Tracks the pose of a foreign autopilot's vehicle from its MAVLink messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.frames import enu_from_ned, flu_enu_from_frd_ned, quaternion_from_euler

Vector = NDArray[np.float64]

_REBOOT_S = 1.0
_LONGEST_EXTRAPOLATION_S = 0.5


class PoseTracker:
    """Combines attitude and local position, which have different stamps.

    There is a pose at each new attitude. The newest position is extrapolated to its stamp with the
    velocity, for 0.5 s at most, so that a slow position stream does not blur frames.

    Args:
        origin_enu_m: Autopilot's local origin in the world (3,).
    """

    def __init__(self, origin_enu_m: Vector) -> None:
        self._origin_enu_m = np.asarray(origin_enu_m, dtype=np.float64)
        self._position: tuple[float, Vector, Vector] | None = None  # stamp, NED m, NED m/s
        self._attitude: tuple[float, Vector] | None = None
        self._has_quaternions = False

    @property
    def has_position(self) -> bool:
        """True once LOCAL_POSITION_NED has arrived."""
        return self._position is not None

    @property
    def has_attitude(self) -> bool:
        """True once ATTITUDE_QUATERNION has arrived, which is preferred to ATTITUDE."""
        return self._has_quaternions

    def take(self, message: Any) -> bool:
        """Handle a message with finite values. Return True if there is a new pose."""
        kind = message.get_type()
        if kind == "LOCAL_POSITION_NED":
            position = np.array([message.x, message.y, message.z], dtype=np.float64)
            velocity = np.array([message.vx, message.vy, message.vz], dtype=np.float64)
            if np.isfinite(position).all():
                velocity = np.nan_to_num(velocity, nan=0.0, posinf=0.0, neginf=0.0)
                self._position = (message.time_boot_ms / 1e3, position, velocity)
            return False
        quaternion = self._quaternion(kind, message)
        if quaternion is None:
            return False
        self._attitude = (message.time_boot_ms / 1e3, quaternion)
        if self._position is not None and self._position[0] > self._attitude[0] + _REBOOT_S:
            self._position = None
        return self._position is not None

    def _quaternion(self, kind: str, message: Any) -> Vector | None:
        if kind == "ATTITUDE_QUATERNION":
            quaternion = np.array([message.q1, message.q2, message.q3, message.q4])
            self._has_quaternions = True
        elif kind == "ATTITUDE" and not self._has_quaternions:
            quaternion = quaternion_from_euler(message.roll, message.pitch, message.yaw)
        else:
            return None
        length = float(np.linalg.norm(quaternion))
        return quaternion / length if math.isfinite(length) and length > 0.5 else None

    def pose(self) -> tuple[float, Vector, Vector]:
        """Return stamp, s, position (3,) in the world and attitude (4,) FLU to ENU.

        Raises:
            LookupError: There is no pose yet.
        """
        if self._position is None or self._attitude is None:
            raise LookupError("no pose yet")
        stamp_s, quaternion = self._attitude
        since_s, position, velocity = self._position
        ahead_s = max(0.0, min(stamp_s - since_s, _LONGEST_EXTRAPOLATION_S))
        local = enu_from_ned(position + ahead_s * velocity)
        return stamp_s, self._origin_enu_m + local, flu_enu_from_frd_ned(quaternion)
