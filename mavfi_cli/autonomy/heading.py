"""Yaw of each waypoint, which points the camera along the direction of travel."""

from __future__ import annotations

import math

import numpy as np

from mavfi_cli.core.frames import wrap_angle
from mavfi_cli.core.types import FloatArray

SHORTEST_M = 0.3  # minimum horizontal distance that defines a direction


def headings(
    positions_enu_m: FloatArray, start_yaw_rad: float, ahead: int, turn_max_rad: float
) -> FloatArray:
    """Return the yaw (n,) of waypoints at positions (n, 3), continuous from `start_yaw_rad`.

    Each yaw points to the position `ahead` waypoints later, or to the first later position that is
    far enough if that one is too near. The yaw stays constant at the end. It turns by at most
    `turn_max_rad` from one waypoint to the next.
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
    """Return the yaw from position k to the first far enough one, `ahead` or more later."""
    ways = positions[min(k + ahead, len(positions) - 1) :, :2] - positions[k, :2]
    far = np.flatnonzero(np.hypot(ways[:, 0], ways[:, 1]) >= SHORTEST_M)
    if not len(far):
        return None
    return math.atan2(ways[far[0], 1], ways[far[0], 0])


def turn_time_s(
    yaw_rad: float, direction: FloatArray, threshold_rad: float, rate_radps: float
) -> float:
    """Return the time to turn from a yaw to a direction of travel (3,).

    It is 0 within the threshold and for a vertical direction.
    """
    if math.hypot(direction[0], direction[1]) < 0.1 or not math.isfinite(yaw_rad):
        return 0.0
    turn = abs(wrap_angle(math.atan2(direction[1], direction[0]) - yaw_rad))
    return turn / rate_radps if turn > threshold_rad else 0.0
