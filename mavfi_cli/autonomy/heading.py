"""Where the camera looks: the yaw of each waypoint along the direction of travel."""

from __future__ import annotations

import math

import numpy as np

from mavfi_cli.core.frames import wrap_angle
from mavfi_cli.core.types import FloatArray

SHORTEST_M = 0.3  # a shorter horizontal way has no direction worth turning to


def headings(
    positions_enu_m: FloatArray, start_yaw_rad: float, ahead: int, turn_max_rad: float
) -> FloatArray:
    """Yaw (n,) of waypoints at positions (n, 3), continuous from `start_yaw_rad`.

    Each looks to where the vehicle is `ahead` waypoints later, or, where that is too near, to
    where it is when it next gets away; at the end the yaw stays. From one waypoint to the next
    it turns by at most `turn_max_rad`.
    """
    count = len(positions_enu_m)
    yaws = np.empty(count)
    yaw = yaws[0] = start_yaw_rad if math.isfinite(start_yaw_rad) else 0.0
    for k in range(1, count):
        wanted = _direction(positions_enu_m, k, ahead)
        if wanted is not None:
            yaw += float(np.clip(wrap_angle(wanted - yaw), -turn_max_rad, turn_max_rad))
        yaws[k] = yaw
    return yaws


def _direction(positions: FloatArray, k: int, ahead: int) -> float | None:
    """Yaw from position k to the first one, `ahead` or more later, that is far enough."""
    ways = positions[min(k + ahead, len(positions) - 1) :, :2] - positions[k, :2]
    far = np.flatnonzero(np.hypot(ways[:, 0], ways[:, 1]) >= SHORTEST_M)
    if not len(far):
        return None
    return math.atan2(ways[far[0], 1], ways[far[0], 0])


def turn_time_s(
    yaw_rad: float, direction: FloatArray, threshold_rad: float, rate_radps: float
) -> float:
    """Time to turn from a yaw to a direction (3,) of travel; 0 within the threshold or vertical."""
    if math.hypot(direction[0], direction[1]) < 0.1 or not math.isfinite(yaw_rad):
        return 0.0
    turn = abs(wrap_angle(math.atan2(direction[1], direction[0]) - yaw_rad))
    return turn / rate_radps if turn > threshold_rad else 0.0
