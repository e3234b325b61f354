"""Smoothing: turns a path into a trajectory within the limits, sampled every 0.5 s.

On each straight segment of the path the vehicle accelerates at a constant rate, cruises, and brakes
at a constant rate. One blend of constant acceleration cuts each corner, from velocity c u_1 to
c u_2 (c the corner speed, u the directions). It lasts |c u_2 - c u_1| / a, starts and ends
h = c^2 sin(theta / 2) / a from the corner, and passes it at a distance of
c^2 sin(theta / 2)^2 / (2 a). The velocity is continuous. The norms of velocity and acceleration
never exceed their limits, because the velocity inside a blend is a convex combination of the
velocities at its ends.

The samples of this motion at equal intervals are the control points of a uniform quadratic
B-spline, and the knots of the spline are the waypoints. Interpolated as in `tracking`
(p + v t + a t^2 / 2), the waypoints are exactly that spline. Between them, the following holds:

- speed and acceleration never exceed those of the sampled motion, because each is an average
  over that motion;
- position and velocity are continuous, and each piece lies in the triangle of three control
  points, within a T^2 / 8 (9 cm) of the motion;
- the spline starts at exactly the given position and velocity and ends at rest on the last point.

If a piece of the spline is not free, the vehicle slows down at the corners that the piece rounds.
In the limit it stops on the corner itself, which lies on the free path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.minimum_snap import MinimumSnap
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.core.frames import norm, wrap_angle
from mavfi_cli.core.types import FloatArray, Trajectory

SHORTEST_M = 0.3  # minimum horizontal distance that defines a direction
NEGLIGIBLE_MPS = 0.1  # lower speeds count as rest
RUN_OUT_RESERVE = 1.02  # factor on the stopping distance, for rounding errors
SLOWEST_SQUARED = 0.1  # a corner slower than this (squared, m^2/s^2) becomes a stop


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothingParams:
    """Limits and sampling of trajectories.

    v_max, a_max, the yaw rate and the sample period of 0.5 s are those of the released code
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
    def acceleration_mps2(self) -> float:
        """The acceleration of the planned motion, which is a share of the limit `a_max_mps2`."""
        return self.acceleration_share * self.a_max_mps2


def smooth(
    path_enu_m: FloatArray, grid: ObstacleGrid, request: PlanRequest, params: SmoothingParams
) -> tuple[Trajectory, bool]:
    """Compute the trajectory along a free path (n, 3) from its first to its last point.

    It begins with the request's velocity, limited to v_max. A trajectory that begins in motion
    first runs straight on for the stopping distance, then turns to the path as fast as the corner
    allows.

    Returns:
        The trajectory, and True if all of it lies in free space.
    """
    velocity = _cut(request.velocity_enu_mps, params.v_max_mps)
    path = np.asarray(path_enu_m, np.float64)
    vertices, free = _with_run_out(path, velocity, grid, params)
    line, period, a = _Polyline(vertices, params), params.sample_period_s, params.acceleration_mps2
    speed = norm(velocity)
    before = path[0] - 0.5 * period * velocity
    # squared speeds at which each corner is cut by at most `corner_cut_m`
    caps = 2.0 * a * params.corner_cut_m / np.maximum(line.half_sines, 1e-6) ** 2
    for _ in range(params.passes_max):
        q = _squared_corner_speeds(line, speed, caps, a)
        moving = _motion(line, q, _dwells(line.directions, q, request.yaw_rad, params), a)
        count = math.ceil(moving.duration_s / period) + 2
        ahead = moving.position(np.arange(count, dtype=np.float64) * period)
        spline = np.vstack([before, ahead])
        blamed = [c for c in _blocked_corners(spline, moving, grid, period) if q[c] > 0.0]
        if not blamed:
            break
        caps[blamed] = np.where(q[blamed] > SLOWEST_SQUARED, 0.25 * q[blamed], 0.0)
    free = free and bool(_piecewise_free(spline, grid).all())
    return _trajectory(spline, request, params), free


def smooth_as_released(
    path_enu_m: FloatArray, grid: ObstacleGrid, request: PlanRequest, params: SmoothingParams
) -> tuple[Trajectory, bool]:
    """Compute the trajectory of the released planner. Arguments and result are those of `smooth`.

    One point differs. The release gives each waypoint the position of the next sample. Our waypoint
    has the position, velocity and acceleration of one moment, because our reference moves between
    waypoints (see `tracking`).
    """
    curve = MinimumSnap.through(
        np.asarray(path_enu_m, np.float64),
        _cut(request.velocity_enu_mps, params.v_max_mps),
        grid.path_free,
        v_max_mps=params.v_max_mps,
        a_max_mps2=params.a_max_mps2,
        passes_max=params.passes_max,
    )
    return _sampled(*curve.sampled(params.sample_period_s), request, params), curve.free


def _cut(velocity: FloatArray, limit: float) -> FloatArray:
    """Limit the speed of a velocity (3,). Return zero if it is negligible or not finite."""
    velocity = np.asarray(velocity, np.float64)
    largest = float(np.abs(velocity).max())
    if not np.isfinite(velocity).all() or largest == 0.0:
        return np.zeros(3)
    speed = largest * norm(velocity / largest)
    if speed < NEGLIGIBLE_MPS:
        return np.zeros(3)
    return velocity if speed <= limit else velocity / largest * (limit * largest / speed)


def _with_run_out(
    path: FloatArray, velocity: FloatArray, grid: ObstacleGrid, params: SmoothingParams
) -> tuple[FloatArray, bool]:
    """Return the vertices (m, 3) to fly, and True if the straight run-out from the start is free.

    A vehicle in motion runs straight on for half a sample, then brakes to a stop. From there the
    path leads to the farthest path vertex in line of sight, or back to the start of the path if
    none is in sight.
    """
    speed = norm(velocity)
    if speed == 0.0:
        return path, True
    begin = path[0] + 0.5 * params.sample_period_s * velocity
    braking_s = 0.5 * speed / params.acceleration_mps2
    stop = begin + RUN_OUT_RESERVE * braking_s * velocity
    free = grid.segment_free(path[0], stop)
    for k in range(len(path) - 1, 0, -1):
        if grid.segment_free(stop, path[k]):
            return np.vstack([begin, stop, path[k:]]), free
    return np.vstack([begin, stop, path]), free


class _Polyline:
    """The geometry of a path (n, 3). Points within 1 mm of their predecessor are dropped."""

    def __init__(self, path: FloatArray, params: SmoothingParams) -> None:
        kept = [path[0]]
        for vertex in path[1:]:
            if norm(vertex - kept[-1]) > 1e-3:
                kept.append(vertex)
        self.vertices = np.array(kept)  # (n, 3)
        steps = np.diff(self.vertices, axis=0)
        self.lengths = np.linalg.norm(steps, axis=1)  # (n - 1,)
        self.directions = steps / self.lengths[:, None]  # (n - 1, 3)
        rises = self.directions[:, 2]
        with np.errstate(divide="ignore", over="ignore"):  # a level segment has no limit
            vertical = np.where(rises < 0.0, params.descent_max_mps, params.climb_max_mps)
            caps = vertical / np.abs(rises)
        # (n - 1,) highest speed along each segment, m/s
        self.speed_caps = np.minimum(caps, params.speed_share * params.v_max_mps)
        # (n,) sin of half the turn at each vertex, 0 at the ends; |u_2 - u_1| = 2 sin(theta / 2)
        self.half_sines = np.zeros(len(self.vertices))
        self.half_sines[1:-1] = 0.5 * np.linalg.norm(np.diff(self.directions, axis=0), axis=1)


def _squared_corner_speeds(
    line: _Polyline, start_speed_mps: float, caps: FloatArray, a: float
) -> FloatArray:
    """Return the highest squared speed that caps and segment lengths allow at each vertex (n,).

    The motion begins at the start speed and ends at rest. `caps` (n,) are squared speeds, `a` is an
    acceleration. The first segment must be long enough to stop from the start speed.
    """
    lengths, sines = line.lengths, line.half_sines
    last = len(lengths)
    q = np.minimum(caps, np.inf)
    q[0], q[last] = start_speed_mps**2, 0.0
    for i in range(1, last):
        q[i] = min(q[i], line.speed_caps[i - 1] ** 2, line.speed_caps[i] ** 2)
        if sines[i] > 0.0:
            q[i] = min(q[i], 0.5 * min(lengths[i - 1], lengths[i]) * a / sines[i])
    if last > 1 and sines[1] > 0.5:  # the first corner's blend shortens the braking distance
        room = 2.0 * a * lengths[0] - q[0]
        q[1] = min(q[1], max(0.0, room) / (2.0 * sines[1] - 1.0))
    for _ in range(last + 2):
        before = q.copy()
        for i in range(last - 1):
            q[i + 1] = min(q[i + 1], _reachable(q[i], sines[i], sines[i + 1], lengths[i], a))
        for i in range(last - 1, 0, -1):
            q[i] = min(q[i], _reachable(q[i + 1], sines[i + 1], sines[i], lengths[i], a))
        if np.array_equal(before, q):
            return q
    q[1:] = 0.0
    return q


def _reachable(q_from: float, sine_from: float, sine_to: float, length: float, a: float) -> float:
    """Return the largest squared speed at one end of a segment, given `q_from` at the other end."""
    return max(0.0, (q_from * (1.0 - 2.0 * sine_from) + 2.0 * a * length) / (1.0 + 2.0 * sine_to))


def _dwells(
    directions: FloatArray, q: FloatArray, yaw_rad: float, params: SmoothingParams
) -> FloatArray:
    """Return the waiting time in seconds at each vertex (n,), including time to turn at rest.

    `q` (n,) are the squared speeds at the vertices.
    """
    dwells = np.zeros(len(q))
    for i, direction in enumerate(directions):
        steep = math.hypot(direction[0], direction[1]) < 0.1
        azimuth = math.atan2(direction[1], direction[0])
        if q[i] == 0.0:
            # Two control points on a corner keep the spline on the two segments.
            dwells[i] = 2.0 * params.sample_period_s if i > 0 else 0.0
            undefined = steep or not math.isfinite(yaw_rad)
            turn = 0.0 if undefined else abs(wrap_angle(azimuth - yaw_rad))
            if turn > params.turn_first_rad:
                dwells[i] = max(turn / params.yaw_rate_max_radps, dwells[i])
        if not steep:
            yaw_rad = azimuth
    return dwells


class _Motion:
    """A motion of consecutive phases of constant acceleration, which are appended one by one."""

    def __init__(self, position: FloatArray) -> None:
        self.duration_s = 0.0
        self.end = position  # (3,) where the phases so far end
        self._rows: list[tuple[float, FloatArray, FloatArray, FloatArray, int]] = []

    def add(
        self, duration_s: float, velocity: FloatArray, acceleration: FloatArray, corner: int = -1
    ) -> None:
        """Append a phase that starts at `velocity` (3,). Ignore it if its duration is not positive.

        `corner` is the index of the vertex that the phase rounds or waits at, or -1 for none.
        """
        if not duration_s > 0.0:
            return
        self._rows.append((self.duration_s, self.end, velocity, acceleration, corner))
        self.duration_s += duration_s
        self.end = self.end + velocity * duration_s + 0.5 * acceleration * duration_s * duration_s

    def change_speed(self, direction: FloatArray, begin: float, end: float, a: float) -> None:
        """Append a phase that changes the speed along a direction (3,) from `begin` to `end`."""
        rate = math.copysign(a, end - begin)
        self.add((end - begin) / rate, begin * direction, rate * direction)

    def position(self, times_s: FloatArray) -> FloatArray:
        """Return the positions (k, 3) at the times (k,). After its end, the motion is at rest."""
        starts_s, positions, velocities, accelerations, _ = map(
            np.array, zip(*self._rows, strict=True)
        )
        times = np.clip(times_s, 0.0, self.duration_s)
        index = np.searchsorted(starts_s, times, side="right") - 1
        t = (times - starts_s[index])[:, None]
        position: FloatArray = (
            positions[index] + velocities[index] * t + 0.5 * accelerations[index] * t * t
        )
        return position

    def corners_during(self, begin_s: float, end_s: float) -> set[int]:
        """Return the indices of the vertices that phases in a time interval round or wait at."""
        starts_s = [row[0] for row in self._rows]
        ends_s = [*starts_s[1:], self.duration_s]
        return {
            row[4]
            for row, phase_ends_s in zip(self._rows, ends_s, strict=True)
            if row[0] <= end_s and phase_ends_s >= begin_s and row[4] >= 0
        }


def _motion(line: _Polyline, q: FloatArray, dwells_s: FloatArray, a: float) -> _Motion:
    """Return the motion along a path that passes its vertices at squared speeds `q` (n,).

    `dwells_s` (n,) is the waiting time at each vertex. It must be 0 unless the speed there is 0.
    """
    motion = _Motion(line.vertices[0])
    zero = np.zeros(3)
    motion.add(dwells_s[0], zero, zero, 0)
    speeds = np.sqrt(q)
    trims = q * line.half_sines / a
    for i, direction in enumerate(line.directions):
        distance = max(0.0, float(line.lengths[i] - trims[i] - trims[i + 1]))
        first, last = float(speeds[i]), float(speeds[i + 1])
        # Accelerate as far as the cap and the distance allow, cruise, and brake.
        peak = math.sqrt(max(0.0, a * distance + 0.5 * (first * first + last * last)))
        peak = max(min(peak, line.speed_caps[i]), last)
        used = (abs(peak * peak - first * first) + abs(peak * peak - last * last)) / (2.0 * a)
        motion.change_speed(direction, first, peak, a)
        if peak > 0.0:
            motion.add((distance - used) / peak, peak * direction, zero)
        motion.change_speed(direction, peak, last, a)
        if i + 1 < len(line.directions):
            if q[i + 1] > 0.0:
                turn = speeds[i + 1] * (line.directions[i + 1] - direction)
                lasting = norm(turn) / a
                if lasting > 0.0:
                    motion.add(lasting, speeds[i + 1] * direction, turn / lasting, i + 1)
            else:
                motion.end = line.vertices[i + 1]  # drops accumulated rounding errors
                motion.add(dwells_s[i + 1], zero, zero, i + 1)
    motion.end = line.vertices[-1]
    motion.add(1e-3, zero, zero)
    return motion


def _blocked_corners(
    spline: FloatArray, moving: _Motion, grid: ObstacleGrid, period: float
) -> list[int]:
    """Return the indices of the vertices that blocked pieces of the spline round or wait at."""
    blamed: set[int] = set()
    for piece in np.flatnonzero(~_piecewise_free(spline, grid)):
        # Piece k depends on the control points at (k - 1) T, k T and (k + 1) T.
        blamed |= moving.corners_during((piece - 1) * period, (piece + 1) * period)
    return sorted(blamed)


def _piecewise_free(spline: FloatArray, grid: ObstacleGrid) -> NDArray[np.bool_]:
    """Return, for each of the m - 2 pieces of a spline, True if its four chords are free."""
    first, second, third = spline[:-2, None], spline[1:-1, None], spline[2:, None]
    u = np.linspace(0.0, 1.0, 5)[:, None]
    # (m - 2, 5, 3)
    points = 0.5 * (1.0 - u) ** 2 * first + (0.5 + u - u * u) * second + 0.5 * u * u * third
    return np.array([grid.path_free(piece) for piece in points], np.bool_)


def _trajectory(spline: FloatArray, request: PlanRequest, params: SmoothingParams) -> Trajectory:
    """Convert control points (m, 3) to a trajectory whose waypoints are the m - 1 knots."""
    period = params.sample_period_s
    velocities = np.diff(spline, axis=0) / period
    accelerations = np.zeros_like(velocities)
    accelerations[:-1] = np.diff(velocities, axis=0) / period
    positions = 0.5 * (spline[:-1] + spline[1:])
    return _sampled(positions, velocities, accelerations, request, params)


def _sampled(
    positions_enu_m: FloatArray,
    velocities_enu_mps: FloatArray,
    accelerations_enu_mps2: FloatArray,
    request: PlanRequest,
    params: SmoothingParams,
) -> Trajectory:
    """Build the requested trajectory from samples (n, 3) that are one sample period apart."""
    period = params.sample_period_s
    yaws = _headings(positions_enu_m, request.yaw_rad, params.yaw_rate_max_radps * period)
    states = [positions_enu_m, yaws, velocities_enu_mps, accelerations_enu_mps2]
    return Trajectory(
        stamp_s=request.stamp_s,
        waypoints=np.column_stack(states),
        durations_s=np.full(len(positions_enu_m), period),
        trajectory_seq=request.trajectory_seq,
        future_collision_seq=request.future_collision_seq,
    )


def _headings(positions: FloatArray, start_yaw_rad: float, turn_max_rad: float) -> FloatArray:
    """Return the yaw (n,) of waypoints at positions (n, 3), continuous from `start_yaw_rad`.

    Each yaw points to the position two waypoints later or, if that is too near, to the first later
    position that is far enough. The yaw stays constant at the end. It turns by at most
    `turn_max_rad` from one waypoint to the next.
    """
    yaws = np.empty(len(positions))
    yaw = yaws[0] = start_yaw_rad if math.isfinite(start_yaw_rad) else 0.0
    for k in range(1, len(positions)):
        ways = positions[min(k + 2, len(positions) - 1) :, :2] - positions[k, :2]
        far = np.flatnonzero(np.hypot(ways[:, 0], ways[:, 1]) >= SHORTEST_M)
        if len(far):
            wanted = math.atan2(ways[far[0], 1], ways[far[0], 0])
            yaw += float(np.clip(wrap_angle(wanted - yaw), -turn_max_rad, turn_max_rad))
        yaws[k] = yaw
    return yaws
