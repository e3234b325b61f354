"""Geometry and speeds of a polyline flown with parabolic corner blends.

On each straight segment the vehicle accelerates constantly, cruises, and brakes constantly. One
blend of constant acceleration cuts each corner, from velocity c u_1 to c u_2 (c the corner speed, u
the directions). It lasts |c u_2 - c u_1| / a, starts and ends h = c^2 sin(theta / 2) / a from the
corner, and passes the corner at c^2 sin(theta / 2)^2 / (2 a). The velocity is continuous. The norms
of velocity and acceleration keep their limits exactly, because the velocity inside a blend is a
convex combination of the velocities at its ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mavfi_cli.core.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLimits:
    """Limits of a motion."""

    speed_mps: float
    climb_mps: float
    descent_mps: float
    acceleration_mps2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Polyline:
    """Vertices (n, 3) without consecutive duplicates, and quantities derived from them."""

    vertices: FloatArray  # (n, 3)
    lengths: FloatArray  # (n - 1,)
    directions: FloatArray  # (n - 1, 3)
    speed_caps: FloatArray  # (n - 1,) m/s
    half_sines: FloatArray  # (n,) sin of half the turn at each vertex; 0 at the ends


def polyline(vertices: FloatArray, limits: MotionLimits) -> _Polyline:
    """Compute the geometry of a path (n, 3) without points within 1 mm of their predecessor."""
    kept = [vertices[0]]
    for vertex in vertices[1:]:
        if np.linalg.norm(vertex - kept[-1]) > 1e-3:
            kept.append(vertex)
    points = np.array(kept)
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / lengths[:, None]
    half_sines = np.zeros(len(points))
    # |u_2 - u_1| = 2 sin(theta / 2)
    half_sines[1:-1] = 0.5 * np.linalg.norm(np.diff(directions, axis=0), axis=1)
    return _Polyline(
        vertices=points,
        lengths=lengths,
        directions=directions,
        speed_caps=np.array([_speed_cap(float(u[2]), limits) for u in directions]),
        half_sines=half_sines,
    )


def _speed_cap(rise: float, limits: MotionLimits) -> float:
    """Return the speed that keeps the vertical limits along a direction of vertical part `rise`."""
    cap = limits.speed_mps
    if rise > 0.0:
        cap = min(cap, limits.climb_mps / rise)
    elif rise < 0.0:
        cap = min(cap, limits.descent_mps / -rise)
    return cap


def squared_corner_speeds(
    line: _Polyline, start_speed_mps: float, caps: FloatArray, acceleration_mps2: float
) -> FloatArray:
    """Return the highest squared speeds at the vertices (n,) that caps and lengths allow.

    The start has its given speed, the end is at rest. `caps` (n,) are squares of speeds. The first
    segment must be long enough to stop from the start speed.
    """
    a = acceleration_mps2
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
    """Return the largest squared speed at one end of a segment, given that at the other end."""
    return max(0.0, (q_from * (1.0 - 2.0 * sine_from) + 2.0 * a * length) / (1.0 + 2.0 * sine_to))


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Consecutive phases of constant acceleration."""

    starts_s: FloatArray  # (m,) start of each phase
    positions: FloatArray  # (m, 3) at the start of each phase
    velocities: FloatArray  # (m, 3)
    accelerations: FloatArray  # (m, 3)
    corners: FloatArray  # (m,) vertex that the phase rounds or waits at; -1 for none
    duration_s: float

    def position(self, times_s: FloatArray) -> FloatArray:
        """Return positions (k, 3) at the times (k,). After its end the motion rests there."""
        times = np.clip(times_s, 0.0, self.duration_s)
        index = np.searchsorted(self.starts_s, times, side="right") - 1
        t = (times - self.starts_s[index])[:, None]
        position: FloatArray = (
            self.positions[index]
            + self.velocities[index] * t
            + 0.5 * self.accelerations[index] * t * t
        )
        return position


class _Phases:
    """Builds a motion phase by phase."""

    def __init__(self, position: FloatArray) -> None:
        self.now_s = 0.0
        self.position = position
        self.rows: list[tuple[float, FloatArray, FloatArray, FloatArray, int]] = []

    def add(
        self, duration_s: float, velocity: FloatArray, acceleration: FloatArray, corner: int = -1
    ) -> None:
        """Append a phase of constant acceleration unless its duration is zero.

        Args:
            duration_s: Duration, s.
            velocity: Velocity at its start (3,), m/s.
            acceleration: Acceleration (3,), m/s^2.
            corner: Vertex that the phase rounds; -1 for none.
        """
        if not duration_s > 0.0:
            return
        self.rows.append((self.now_s, self.position, velocity, acceleration, corner))
        self.now_s += duration_s
        self.position = (
            self.position + velocity * duration_s + 0.5 * acceleration * duration_s * duration_s
        )


def motion(
    line: _Polyline,
    q: FloatArray,
    dwells_s: FloatArray,
    acceleration_mps2: float,
) -> Motion:
    """Return the motion along the line with squared corner speeds `q` (n,).

    `dwells_s` (n,) is the waiting time at each vertex. It must be 0 unless the speed there is 0.
    """
    a = acceleration_mps2
    phases = _Phases(line.vertices[0])
    zero = np.zeros(3)
    phases.add(dwells_s[0], zero, zero, 0)
    speeds = np.sqrt(q)
    trims = q * line.half_sines / a
    for i, direction in enumerate(line.directions):
        distance = max(0.0, float(line.lengths[i] - trims[i] - trims[i + 1]))
        _straight(phases, direction, distance, (speeds[i], speeds[i + 1]), line.speed_caps[i], a)
        if i + 1 < len(line.directions):
            if q[i + 1] > 0.0:
                turn = speeds[i + 1] * (line.directions[i + 1] - direction)
                lasting = float(np.linalg.norm(turn)) / a
                if lasting > 0.0:
                    phases.add(lasting, speeds[i + 1] * direction, turn / lasting, i + 1)
            else:
                phases.position = line.vertices[i + 1]  # drops accumulated rounding errors
                phases.add(dwells_s[i + 1], zero, zero, i + 1)
    phases.position = line.vertices[-1]
    phases.add(1e-3, zero, zero)
    starts, positions, velocities, accelerations, corners = zip(*phases.rows, strict=True)
    return Motion(
        starts_s=np.array(starts),
        positions=np.array(positions),
        velocities=np.array(velocities),
        accelerations=np.array(accelerations),
        corners=np.array(corners, np.float64),
        duration_s=phases.now_s,
    )


def _straight(
    phases: _Phases,
    direction: FloatArray,
    distance: float,
    speeds: tuple[float, float],
    cap: float,
    a: float,
) -> None:
    """Accelerate as far as the cap and the distance allow, cruise, and brake."""
    first, last = float(speeds[0]), float(speeds[1])
    peak = math.sqrt(max(0.0, a * distance + 0.5 * (first * first + last * last)))
    peak = max(min(peak, cap), last)
    used = (abs(peak * peak - first * first) + abs(peak * peak - last * last)) / (2.0 * a)
    _change(phases, direction, first, peak, a)
    if peak > 0.0:
        phases.add((distance - used) / peak, peak * direction, np.zeros(3))
    _change(phases, direction, peak, last, a)


def _change(phases: _Phases, direction: FloatArray, begin: float, end: float, a: float) -> None:
    """Change speed along a line."""
    rate = math.copysign(a, end - begin)
    phases.add((end - begin) / rate, begin * direction, rate * direction)
