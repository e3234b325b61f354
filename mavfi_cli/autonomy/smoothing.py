"""Smoothing: turns a path into a trajectory within the limits, sampled every 0.5 s.

The motion along the path has constant accelerations and parabolic corners (see `corners`). Its
samples at equal times are the control points of a uniform quadratic B-spline, and the knots of the
spline are the waypoints. Interpolated as in `trajectory` (p + v t + a t^2 / 2), the waypoints are
exactly that spline. Between the waypoints, too:

- speed and acceleration never exceed those of the motion that was sampled: each is an average
  of it;
- position and velocity are continuous, and each piece lies in the triangle of three control
  points, within a T^2 / 8 (9 cm) of the motion;
- it starts at exactly the given position and velocity and ends at rest on the last point.

If a piece is not free, the corners that it rounds are slowed down, in the limit to a stop on the
corner itself, which lies on the free path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.autonomy import corners
from mavfi_cli.autonomy.corners import Motion, MotionLimits
from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.pilot import Departure
from mavfi_cli.core.frames import wrap_angle
from mavfi_cli.core.types import FloatArray, Trajectory

SHORTEST_M = 0.3  # minimum horizontal distance that defines a direction

NEGLIGIBLE_MPS = 0.1  # lower speeds count as rest
RUN_OUT_RESERVE = 1.02  # factor on the stopping distance, for rounding errors
SLOWEST_SQUARED = 0.1  # a corner slower than this (squared, m^2/s^2) becomes a stop


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


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothingParams:
    """Limits and sampling of trajectories.

    v_max, a_max, the yaw rate and the 0.5 s of the samples are those of the released code
    (MAVBench/MAV_apps, branch mavfi). The shares leave the tracker room to catch up. The vertical
    limits are those of common autopilots.
    """

    v_max_mps: float = 3.0
    a_max_mps2: float = 5.0
    speed_share: float = 0.9
    acceleration_share: float = 0.6
    climb_max_mps: float = 2.0
    descent_max_mps: float = 1.5
    yaw_rate_max_radps: float = math.pi / 2.0
    sample_period_s: float = 0.5
    corner_cut_m: float = 0.5  # maximum distance by which a corner is cut
    turn_first_rad: float = math.pi / 4.0  # a larger turn is made at rest before departure
    passes_max: int = 40

    @property
    def limits(self) -> MotionLimits:
        """Return the limits of the planned motion."""
        return MotionLimits(
            speed_mps=self.speed_share * self.v_max_mps,
            climb_mps=self.climb_max_mps,
            descent_mps=self.descent_max_mps,
            acceleration_mps2=self.acceleration_share * self.a_max_mps2,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Smoothed:
    """A trajectory, and a flag that is True if all of it lies in free space."""

    trajectory: Trajectory
    free: bool


def smooth(
    path_enu_m: FloatArray,
    grid: ObstacleGrid,
    departure: Departure,
    params: SmoothingParams,
) -> _Smoothed:
    """Compute the trajectory along a free path (n, 3) from its first to its last point.

    It begins with the departure's velocity, limited to v_max. A trajectory that begins in motion
    first runs straight on for the stopping distance, then turns to the path as fast as the corner
    allows. If the straight part is not free, `free` is False.
    """
    velocity = _cut(departure.velocity_enu_mps, params.v_max_mps)
    path = np.asarray(path_enu_m, np.float64)
    vertices, free = _with_run_out(path, velocity, grid, params)
    limits, period = params.limits, params.sample_period_s
    line = corners.polyline(vertices, limits)
    speed, acceleration = float(np.linalg.norm(velocity)), limits.acceleration_mps2
    before = path[0] - 0.5 * period * velocity
    # squared speeds that cut each corner by `corner_cut_m` at most
    caps = 2.0 * acceleration * params.corner_cut_m / np.maximum(line.half_sines, 1e-6) ** 2
    for _ in range(params.passes_max):
        q = corners.squared_corner_speeds(line, speed, caps, acceleration)
        dwells_s = _dwells(line.directions, q, departure.yaw_rad, params)
        moving = corners.motion(line, q, dwells_s, acceleration)
        count = math.ceil(moving.duration_s / period) + 2
        ahead = moving.position(np.arange(count, dtype=np.float64) * period)
        spline = np.vstack([before, ahead])
        blamed = [c for c in _blocked_corners(spline, moving, grid, params) if q[c] > 0.0]
        if not blamed:
            break
        caps[blamed] = np.where(q[blamed] > SLOWEST_SQUARED, 0.25 * q[blamed], 0.0)
    free = free and bool(_piecewise_free(spline, grid).all())
    return _Smoothed(trajectory=_waypoints(spline, departure, params), free=free)


def _dwells(
    directions: FloatArray, q: FloatArray, yaw_rad: float, params: SmoothingParams
) -> FloatArray:
    """Return the waiting time at each vertex (n,), which includes the time to turn at rest."""
    dwells = np.zeros(len(q))
    for i, direction in enumerate(directions):
        if q[i] == 0.0:
            turning = turn_time_s(
                yaw_rad, direction, params.turn_first_rad, params.yaw_rate_max_radps
            )
            # Two control points on a corner keep the spline on the two segments.
            settling = 2.0 * params.sample_period_s if i > 0 else 0.0
            dwells[i] = max(turning, settling)
        if math.hypot(direction[0], direction[1]) >= 0.1:
            yaw_rad = math.atan2(direction[1], direction[0])
    return dwells


def _cut(velocity: FloatArray, limit: float) -> FloatArray:
    """Limit a velocity (3,). Return zero if it is negligible or not finite."""
    velocity = np.asarray(velocity, np.float64)
    if not np.isfinite(velocity).all():
        return np.zeros(3)
    largest = float(np.abs(velocity).max())
    if largest == 0.0:
        return np.zeros(3)
    speed = largest * float(np.linalg.norm(velocity / largest))
    if speed < NEGLIGIBLE_MPS:
        return np.zeros(3)
    return velocity if speed <= limit else velocity / largest * (limit * largest / speed)


def _run_out(position: FloatArray, velocity: FloatArray, params: SmoothingParams) -> FloatArray:
    """Return vertices (1 or 2, 3) that run straight on for half a sample, then brake to a stop."""
    speed = float(np.linalg.norm(velocity))
    if speed == 0.0:
        return np.array([position])
    begin = position + 0.5 * params.sample_period_s * velocity
    braking_s = 0.5 * speed / params.limits.acceleration_mps2
    return np.array([begin, begin + RUN_OUT_RESERVE * braking_s * velocity])


def _with_run_out(
    path: FloatArray, velocity: FloatArray, grid: ObstacleGrid, params: SmoothingParams
) -> tuple[FloatArray, bool]:
    """Return the vertices to fly, and True if the straight stretch from the start is free.

    From the stopping point the path leads to the farthest path vertex in line of sight, or back to
    the start of the path if none is in sight.
    """
    vertices = _run_out(path[0], velocity, params)
    if len(vertices) == 1:
        return path, True
    stop = vertices[-1]
    free = grid.segment_free(path[0], stop)
    for k in range(len(path) - 1, 0, -1):
        if grid.segment_free(stop, path[k]):
            return np.vstack([vertices, path[k:]]), free
    return np.vstack([vertices, path]), free


def _blocked_corners(
    spline: FloatArray, moving: Motion, grid: ObstacleGrid, params: SmoothingParams
) -> list[int]:
    """Return the vertices that are rounded by spline pieces that are not free."""
    period = params.sample_period_s
    blamed: set[int] = set()
    ends_s = np.append(moving.starts_s[1:], moving.duration_s)
    for piece in np.flatnonzero(~_piecewise_free(spline, grid)):
        # Piece k depends on the control points at (k - 1) T, k T and (k + 1) T.
        begin_s, end_s = (piece - 1) * period, (piece + 1) * period
        during = (moving.starts_s <= end_s) & (ends_s >= begin_s) & (moving.corners >= 0)
        blamed.update(moving.corners[during].astype(int).tolist())
    return sorted(blamed)


def _piecewise_free(spline: FloatArray, grid: ObstacleGrid) -> NDArray[np.bool_]:
    """Return a flag for each spline piece (m - 2,): True if its four chords are free."""
    first, second, third = spline[:-2, None], spline[1:-1, None], spline[2:, None]
    u = np.linspace(0.0, 1.0, 5)[:, None]
    points = (
        0.5 * (1.0 - u) ** 2 * first + (0.5 + u - u * u) * second + 0.5 * u * u * third
    )  # (m - 2, 5, 3)
    return np.array([grid.path_free(piece) for piece in points], np.bool_)


def _waypoints(spline: FloatArray, departure: Departure, params: SmoothingParams) -> Trajectory:
    """Convert control points (m, 3) to the trajectory of the spline's m - 1 knots."""
    period = params.sample_period_s
    velocities = np.diff(spline, axis=0) / period
    accelerations = np.zeros_like(velocities)
    accelerations[:-1] = np.diff(velocities, axis=0) / period
    waypoints = np.empty((len(velocities), 10))
    waypoints[:, 0:3] = 0.5 * (spline[:-1] + spline[1:])
    waypoints[:, 3] = headings(
        waypoints[:, 0:3], departure.yaw_rad, 2, params.yaw_rate_max_radps * period
    )
    waypoints[:, 4:7] = velocities
    waypoints[:, 7:10] = accelerations
    return Trajectory(
        stamp_s=departure.stamp_s,
        waypoints=waypoints,
        durations_s=np.full(len(waypoints), period),
        trajectory_seq=departure.trajectory_seq,
        future_collision_seq=departure.future_collision_seq,
    )
