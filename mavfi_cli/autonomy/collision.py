"""Collision check of the whole remaining trajectory against the map, with FCL on the octree.

The vehicle is a sphere. The check places spheres along the reference that the tracker will follow
so that they cover the swept capsule: spheres of radius sqrt(r^2 + (s/2)^2) at spacing s contain
the capsule of radius r. Unknown space is free, as in MAVBench.

With `refuses_far_waypoints`, a waypoint that is not finite or is too far away counts as a
collision. Otherwise the check looks for obstacles in the known map only, as MAVBench's ray casting
does: it follows the path to a far waypoint for at most `REACH_M`, and skips a waypoint that is not
finite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import fcl
import numpy as np
from numpy.typing import NDArray

from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.tracking import locate, reference_waypoint
from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import CollisionReport, FloatArray, Trajectory

MAX_SAMPLES = 4096
MAX_SAMPLES_A_PIECE = 256
LONGEST_DURATION_S = 60.0
REACH_M = 150.0  # longest distance between two waypoints inside any map
FASTEST_MPS = 100.0  # a faster vehicle would leave the map within one waypoint's duration


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionParams:
    """Parameters of the collision check, such as the size of the vehicle and the sample spacing.

    The radius is the body's half diagonal (about 0.3 m for `solo`) plus a margin for tracking
    error, depth quantisation (0.1 m) and half a voxel. MAVBench uses a box of 1.5 m.
    """

    radius_m: float = 0.9
    spacing_m: float = 0.2
    body_radius_m: float = 0.35  # lower limit of the radius if the vehicle starts in contact
    refuses_far_waypoints: bool = True
    farthest_m: float = 1000.0  # per axis, from the current waypoint; a farther point is unflyable
    owns_sequence_numbers: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionState:
    """The state that the collision check keeps from one call of `step` to the next."""

    future_collision_seq: int = 0
    foreseen_on_seq: int | None = None  # trajectory on which a collision is predicted


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionInputs:
    """The inputs of one call of `step`."""

    stamp_s: float
    snapshot: MapSnapshot
    trajectory: Trajectory | None
    time_s: float  # time on the trajectory, since its first waypoint
    front_enu_m: FloatArray | None = None  # (3,) start of the checked path; None: the path's own


def step(
    state: CollisionState, inputs: CollisionInputs, params: CollisionParams
) -> tuple[CollisionState, CollisionReport]:
    """Check the rest of the trajectory for collisions. Return the new state and the report.

    The report's time_to_collision_s is the time from `inputs.time_s` along the trajectory to the
    first contact, or inf if there is none. future_collision_seq increases by one when the check
    predicts a collision on a trajectory that was free or unchecked before. With
    `refuses_far_waypoints`, a point that is not finite or farther than `farthest_m` from the
    current waypoint cannot be flown and counts as a collision at its time.
    """
    time_s = math.inf
    if inputs.trajectory is not None:
        trajectory = inputs.trajectory
        if inputs.front_enu_m is not None:
            trajectory = _shifted(trajectory, inputs.time_s, inputs.front_enu_m)
        time_s = _time_to_collision(inputs.snapshot, trajectory, inputs.time_s, params)
    collision = math.isfinite(time_s)
    seq, on_seq = state.future_collision_seq, None
    if inputs.trajectory is not None and not params.owns_sequence_numbers:
        # A restarted check continues from the number in the plan.
        seq = max(seq, inputs.trajectory.future_collision_seq)
    if collision and inputs.trajectory is not None:
        on_seq = inputs.trajectory.trajectory_seq
        if state.foreseen_on_seq != on_seq:
            seq = (seq + 1) & 0x7FFF_FFFF
    report = CollisionReport(
        stamp_s=inputs.stamp_s,
        collision=collision,
        time_to_collision_s=time_s,
        future_collision_seq=seq,
    )
    return CollisionState(future_collision_seq=seq, foreseen_on_seq=on_seq), report


def _time_to_collision(
    snapshot: MapSnapshot, trajectory: Trajectory, time_s: float, params: CollisionParams
) -> float:
    """Return the time in seconds from `time_s` along the trajectory to the first contact.

    The time is infinite if the trajectory is free. It is never late, and it is early by at most the
    time for one or two sample spacings.
    """
    farthest_m = params.farthest_m
    if not params.refuses_far_waypoints:
        trajectory, farthest_m = _castable(trajectory), math.inf
    points = np.empty((MAX_SAMPLES, 3))
    times_s = np.empty(MAX_SAMPLES)
    count, unflyable_s = _sample_ahead(
        trajectory.waypoints,
        trajectory.durations_s,
        time_s,
        params.spacing_m,
        farthest_m,
        points,
        times_s,
    )
    if not params.refuses_far_waypoints:
        unflyable_s = math.inf
    if not snapshot.payload:
        return float(unflyable_s)
    hit = _first_contact(snapshot, points[:count], params)
    # The previous sphere is free, so there is no contact before its time.
    return float(times_s[max(hit - 1, 0)]) if hit is not None else float(unflyable_s)


@np.errstate(over="ignore", invalid="ignore")  # waypoints may be corrupted
def _shifted(trajectory: Trajectory, time_s: float, front_enu_m: FloatArray) -> Trajectory:
    """Translate the trajectory so that its reference at `time_s` is `front_enu_m` (3,)."""
    waypoints = trajectory.waypoints.copy()
    waypoints[:, 0:3] += front_enu_m - reference_waypoint(trajectory, time_s)[0:3]
    return replace(trajectory, waypoints=waypoints)


def _castable(trajectory: Trajectory) -> Trajectory:
    """Limit the trajectory to distances and speeds that are possible inside a map.

    A waypoint too far from the previous one is moved closer to it, and one that is too fast is
    slowed down. A waypoint that is not finite is replaced by the previous position at rest.
    """
    waypoints = trajectory.waypoints
    fine: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(waypoints), axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        far = np.abs(np.diff(waypoints[:, 0:3], axis=0)).max(axis=1, initial=0.0) > REACH_M
        fast = np.abs(waypoints[:, 4:10]).max(axis=1, initial=0.0) > FASTEST_MPS
    if fine.all() and not far.any() and not fast.any():
        return trajectory
    waypoints = waypoints.copy()
    for row in range(len(waypoints)):
        if not fine[row]:
            waypoints[row, 4:10] = 0.0
            waypoints[row, 0:4] = waypoints[row - 1, 0:4] if row else np.nan
            continue
        if row and np.isfinite(waypoints[row - 1, 0:3]).all():
            before = waypoints[row - 1, 0:3]
            waypoints[row, 0:3] = before + _within(waypoints[row, 0:3] - before, REACH_M)
        waypoints[row, 4:7] = _within(waypoints[row, 4:7], FASTEST_MPS)
        waypoints[row, 7:10] = _within(waypoints[row, 7:10], FASTEST_MPS)
    return replace(trajectory, waypoints=waypoints)


def _within(vector: FloatArray, limit: float) -> FloatArray:
    """Limit the length of a vector (3,). Safe if its square overflows."""
    largest = float(np.abs(vector).max())
    if largest <= limit / 2.0:
        return vector
    unit = vector / largest
    share = norm(unit)
    return vector if largest * share <= limit else unit * (limit / share)


class _SphereProbe:
    """A sphere that can be tested for contact with a map at any point."""

    def __init__(self, snapshot: MapSnapshot, radius_m: float) -> None:
        tree = fcl.OcTree(snapshot.resolution_m, snapshot.signed_bytes())
        self._map = fcl.CollisionObject(tree)
        self._sphere = fcl.CollisionObject(fcl.Sphere(radius_m))
        self._request = fcl.CollisionRequest()

    def touches(self, point_enu_m: FloatArray) -> bool:
        """Return True if the sphere centred on the point (3,) touches an occupied voxel."""
        self._sphere.setTranslation(point_enu_m)
        result = fcl.CollisionResult()
        return bool(fcl.collide(self._sphere, self._map, self._request, result))


def _first_contact(
    snapshot: MapSnapshot, points: FloatArray, params: CollisionParams
) -> int | None:
    """Return the index of the first of `points` (n, 3) that is in contact, or None if none is.

    A vehicle that is already within the radius of an obstacle may leave it: until a point is free
    at full radius, points within two radii of the start are tested with the body's radius only.
    """
    padding_m = 0.5 * params.spacing_m
    probe = _SphereProbe(snapshot, math.hypot(params.radius_m, padding_m))
    body: _SphereProbe | None = None
    escaping = True
    for index, point in enumerate(points):
        if not probe.touches(point):
            escaping = False
            continue
        if not escaping or norm(point - points[0]) > 2.0 * params.radius_m:
            return index
        body = body or _SphereProbe(snapshot, math.hypot(params.body_radius_m, padding_m))
        if body.touches(point):
            return index
    return None


@compiled
def _sample_ahead(
    waypoints: FloatArray,
    durations_s: FloatArray,
    time_s: float,
    spacing_m: float,
    farthest_m: float,
    points: FloatArray,
    times_s: FloatArray,
) -> tuple[int, float]:
    """Sample the rest of the reference at points that are at most `spacing_m` apart.

    The points of a piece longer than MAX_SAMPLES_A_PIECE times `spacing_m` are farther apart.
    The points and their times are written to `points` and `times_s`. A straight line bridges a gap
    between the end of one waypoint's motion and the next waypoint. Every loop is bounded by the
    number of waypoints, by MAX_SAMPLES_A_PIECE or by `points`.

    Returns:
        The number of samples written, and the time of the first point that cannot be flown, or
        infinity if all can.
    """
    current, elapsed = locate(durations_s, time_s)
    count, now = 0, 0.0
    if current < 0:
        return 0, math.inf
    for index in range(current, min(waypoints.shape[0], durations_s.shape[0])):
        p, v, a = waypoints[index, 0:3], waypoints[index, 4:7], waypoints[index, 7:10]
        start = elapsed if index == current else 0.0
        duration = durations_s[index]
        if not duration > start:
            duration = start
        duration = min(duration, start + LONGEST_DURATION_S)
        span = duration - start
        speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        pull = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
        reach = (speed + pull * start) * span + 0.5 * pull * span * span
        pieces = _pieces(reach, spacing_m)
        for piece in range(pieces + 1):
            t = start + span * piece / pieces
            x = p[0] + v[0] * t + 0.5 * a[0] * t * t
            y = p[1] + v[1] * t + 0.5 * a[1] * t * t
            z = p[2] + v[2] * t + 0.5 * a[2] * t * t
            at_s = now + t - start
            if not _flyable(waypoints[current], x, y, z, farthest_m):
                return count, at_s
            count = _bridge(points, times_s, count, x, y, z, at_s, spacing_m)
        now += span
    return count, math.inf


@compiled
def _pieces(length_m: float, spacing_m: float) -> int:
    """Return the number of pieces, at most `spacing_m` long, into which a length is divided.

    The number is limited to MAX_SAMPLES_A_PIECE.
    """
    wanted = length_m / spacing_m
    if not wanted < MAX_SAMPLES_A_PIECE:
        return MAX_SAMPLES_A_PIECE
    return max(1, math.ceil(wanted))


@compiled
def _flyable(first: FloatArray, x: float, y: float, z: float, farthest_m: float) -> bool:
    dx, dy, dz = abs(x - first[0]), abs(y - first[1]), abs(z - first[2])
    return bool(dx <= farthest_m and dy <= farthest_m and dz <= farthest_m)


@compiled
def _bridge(
    points: FloatArray,
    times_s: FloatArray,
    count: int,
    x: float,
    y: float,
    z: float,
    at_s: float,
    spacing_m: float,
) -> int:
    """Append the point (x, y, z) to `points`, and return the new number of points.

    If the last point is far away, intermediate points are appended first.
    """
    pieces = 1
    if count > 0:
        last = points[count - 1]
        dx, dy, dz = x - last[0], y - last[1], z - last[2]
        gap = math.sqrt(dx * dx + dy * dy + dz * dz)
        if gap < 1e-9:
            return count
        pieces = _pieces(gap, spacing_m)
    base = max(count - 1, 0)
    for piece in range(1, pieces + 1):
        if count >= points.shape[0]:
            return count
        share = piece / pieces
        if piece == pieces:
            points[count, 0], points[count, 1], points[count, 2] = x, y, z
        else:
            for axis, target in enumerate((x, y, z)):
                points[count, axis] = points[base, axis] + share * (target - points[base, axis])
        times_s[count] = at_s
        count += 1
    return count
