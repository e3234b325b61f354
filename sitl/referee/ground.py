"""Rule that tells a landing from a crash into the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class LandingLimits:
    """Limits of a landing, which apply while landing or disarmed.

    PX4 lands at 0.7 m/s (MPC_LAND_SPEED). The limits allow a hard landing on level legs, but
    neither a fall nor a touchdown at cruise speed.
    """

    sink_mps: float = 2.0
    horizontal_mps: float = 1.5
    tilt_rad: float = math.radians(35.0)
    airborne_m: float = 0.3  # height of the lowest corner above which the vehicle is in the air


@dataclass(slots=True, kw_only=True)
class GroundRule:
    """Classifies ground contacts from take-off to landing.

    A vehicle in contact before its first take-off stands on the ground. A later contact is a crash
    unless the flight controller was landing, taking off or disarmed, and the contact is within the
    limits. The limits apply to the speed just before the contact.
    """

    half_m: tuple[float, float, float]  # half sides of the body box
    limits: LandingLimits
    airborne: bool = False
    _velocity_before_mps: Vector | None = None  # (3,) ENU

    def crashed(
        self,
        position_enu_m: Vector,
        quaternion_flu_enu: Vector,
        velocity_enu_mps: Vector,
        *,
        on_ground: bool,
        may_land: bool,
    ) -> bool:
        """Return True if the newest pose is a crash. Call it once per observation."""
        lowest_m, tilt_rad = self._attitude(position_enu_m, quaternion_flu_enu)
        before = self._velocity_before_mps
        velocity = velocity_enu_mps if before is None else before
        self._velocity_before_mps = velocity_enu_mps.copy()
        if lowest_m > self.limits.airborne_m and not on_ground:
            self.airborne = True
            return False
        if not self.airborne or not (on_ground or lowest_m <= 0.0):
            return False
        self.airborne = False
        return not (may_land and self._is_gentle(velocity, tilt_rad))

    def _attitude(self, position: Vector, quaternion: Vector) -> tuple[float, float]:
        """Return the height of the body's lowest corner, m, and the tilt of its up axis, rad."""
        w, x, y, z = quaternion.tolist()
        up = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
        reach = sum(abs(u) * half for u, half in zip(up, self.half_m, strict=True))
        return float(position[2]) - reach, math.acos(max(-1.0, min(1.0, up[2])))

    def _is_gentle(self, velocity: Vector, tilt_rad: float) -> bool:
        limits = self.limits
        return (
            -velocity[2] <= limits.sink_mps
            and math.hypot(velocity[0], velocity[1]) <= limits.horizontal_mps
            and tilt_rad <= limits.tilt_rad
        )
