"""Computes a body's first contact with boxes, and its nearest approach to them, between two poses.

Distance: the shortest distance between two disjoint boxes is between a corner of one and the other
box, or between an edge of one and an edge of the other. A separating-axis test with six face
normals and nine cross products of edges decides whether they overlap (S. Gottschalk, M. Lin,
D. Manocha, "OBBTree", 1996).

Motion: between two poses the body's centre moves in a straight line, and its attitude turns about
one axis at a constant rate. No point of the body then moves further than

    travel = |p1 - p0| + angle * half-diagonal

so a clearance d excludes contact for the fraction d / travel of the motion (conservative
advancement; B. Mirtich, 1996). No step can cross a wall, however thin. The same bound from both
ends of an interval gives the nearest approach (S. Piyavskii, 1972).
"""

from __future__ import annotations

import math

import numpy as np

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.frames import Vector

_PARALLEL = 1e-12
_Ends = tuple[Vector, Vector, Vector, Vector]  # position, attitude; at the start and the end


@compiled
def _point_distance(point: Vector, box: Vector) -> float:
    """Return the distance, m, from a point (3,) to an axis-aligned box (6,), or 0 inside it."""
    total = 0.0
    for axis in range(3):
        gap = max(box[axis] - point[axis], point[axis] - box[axis + 3], 0.0)
        total += gap * gap
    return math.sqrt(total)


@compiled
def _body_distance(centre: Vector, rotation: Vector, half: Vector, box: Vector) -> float:
    """Return the distance, m, from an oriented box to an axis-aligned box, or 0 if they overlap.

    The oriented box has a centre (3,) in the world, half sides (3,), and a rotation (3, 3) from
    body to world. The axis-aligned box is (6,) xmin ymin zmin xmax ymax zmax.
    """
    if _overlap(centre, rotation, half, box):
        return 0.0
    best = math.inf
    for corner in range(8):
        best = min(best, _body_corner_squared(corner, centre, rotation, half, box))
        best = min(best, _box_corner_squared(corner, centre, rotation, half, box))
    for axis in range(3):
        for edge in range(4):
            for other_axis in range(3):
                for other in range(4):
                    best = min(
                        best,
                        _edges_squared(axis, edge, other_axis, other, centre, rotation, half, box),
                    )
    return math.sqrt(best)


@compiled
def _overlap(centre: Vector, rotation: Vector, half: Vector, box: Vector) -> bool:
    """Return True if the boxes overlap or touch, by a separating-axis test."""
    offset = (
        centre[0] - 0.5 * (box[0] + box[3]),
        centre[1] - 0.5 * (box[1] + box[4]),
        centre[2] - 0.5 * (box[2] + box[5]),
    )
    side = (0.5 * (box[3] - box[0]), 0.5 * (box[4] - box[1]), 0.5 * (box[5] - box[2]))
    for i in range(3):
        reach = side[i]
        for j in range(3):
            reach += half[j] * abs(rotation[i, j])
        if abs(offset[i]) > reach:
            return False
    for j in range(3):
        reach, along = half[j], 0.0
        for i in range(3):
            reach += side[i] * abs(rotation[i, j])
            along += offset[i] * rotation[i, j]
        if abs(along) > reach:
            return False
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            reach = (
                side[a] * abs(rotation[b, j])
                + side[b] * abs(rotation[a, j])
                + half[c] * abs(rotation[i, d])
                + half[d] * abs(rotation[i, c])
            )
            if abs(offset[b] * rotation[a, j] - offset[a] * rotation[b, j]) > reach:
                return False
    return True


@compiled
def _body_corner_squared(
    corner: int, centre: Vector, rotation: Vector, half: Vector, box: Vector
) -> float:
    total = 0.0
    for axis in range(3):
        place = centre[axis]
        for side in range(3):
            sign = 1.0 if corner >> side & 1 else -1.0
            place += sign * half[side] * rotation[axis, side]
        gap = max(box[axis] - place, place - box[axis + 3], 0.0)
        total += gap * gap
    return total


@compiled
def _box_corner_squared(
    corner: int, centre: Vector, rotation: Vector, half: Vector, box: Vector
) -> float:
    total = 0.0
    for side in range(3):
        place = 0.0
        for axis in range(3):
            at = box[axis + 3] if corner >> axis & 1 else box[axis]
            place += (at - centre[axis]) * rotation[axis, side]
        gap = max(abs(place) - half[side], 0.0)
        total += gap * gap
    return total


@compiled
def _edges_squared(
    axis: int,
    edge: int,
    other_axis: int,
    other: int,
    centre: Vector,
    rotation: Vector,
    half: Vector,
    box: Vector,
) -> float:
    """Return the squared distance from one body edge (along body `axis`) to one box edge.

    With r the offset of the edges' midpoints, u and v their directions and h, k their half
    lengths, |r + s u - t v| is minimal where both derivatives vanish. The result is infinity if the
    edges are parallel or the minimum is beyond the end of an edge: the ends of edges are corners,
    which are handled separately.
    """
    one, two = (axis + 1) % 3, (axis + 2) % 3
    sign_one = half[one] if edge & 1 else -half[one]
    sign_two = half[two] if edge & 2 else -half[two]
    along = rotation[other_axis, axis]
    squared, offset_u, offset_v = 0.0, 0.0, 0.0
    for i in range(3):
        place = centre[i] + sign_one * rotation[i, one] + sign_two * rotation[i, two]
        if i == other_axis:
            at = 0.5 * (box[i] + box[i + 3])
        elif i == (other_axis + 1) % 3:
            at = box[i + 3] if other & 1 else box[i]
        else:
            at = box[i + 3] if other & 2 else box[i]
        gap = place - at
        squared += gap * gap
        offset_u += gap * rotation[i, axis]
        if i == other_axis:
            offset_v = gap
    slope = 1.0 - along * along
    if slope < _PARALLEL:
        return math.inf
    s = (along * offset_v - offset_u) / slope
    t = offset_v + s * along
    if abs(s) > half[axis] or abs(t) > 0.5 * (box[other_axis + 3] - box[other_axis]):
        return math.inf
    nearest: float = max(0.0, squared + s * offset_u - t * offset_v)
    return nearest


CONTACT_M = 1e-4  # a smaller distance counts as contact
APPROACH_TOLERANCE_M = 1e-3  # accuracy of the nearest approach between two poses


@compiled
def _pose_at(share: float, ends: _Ends, centre: Vector, rotation: Vector) -> None:
    """Write the pose at a fraction 0..1 of the motion to `centre` (3,) and `rotation` (3, 3)."""
    p0, q0, p1, q1 = ends
    for i in range(3):
        centre[i] = p0[i] + share * (p1[i] - p0[i])
    dot = q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3]
    sign = -1.0 if dot < 0.0 else 1.0
    angle = math.acos(min(1.0, abs(dot)))
    a, b = 1.0 - share, share
    if angle > 1e-6:
        a, b = math.sin(a * angle) / math.sin(angle), math.sin(b * angle) / math.sin(angle)
    w, x = a * q0[0] + sign * b * q1[0], a * q0[1] + sign * b * q1[1]
    y, z = a * q0[2] + sign * b * q1[2], a * q0[3] + sign * b * q1[3]
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    rotation[0, 0], rotation[0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z)
    rotation[1, 0], rotation[1, 1] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z)
    rotation[2, 0], rotation[2, 1] = 2 * (x * z - w * y), 2 * (y * z + w * x)
    rotation[0, 2], rotation[1, 2] = 2 * (x * z + w * y), 2 * (y * z - w * x)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)


@compiled
def clearance(
    position: Vector, quaternion: Vector, half: Vector, boxes: Vector
) -> tuple[float, int]:
    """Return the distance, m, from the body to the nearest box, and the index of that box.

    Without boxes, the distance is infinite and the index is -1.
    """
    centre, rotation = np.empty(3), np.empty((3, 3))
    _pose_at(0.0, (position, quaternion, position, quaternion), centre, rotation)
    reach = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    best, nearest, likely = math.inf, -1, 0
    for index in range(boxes.shape[0]):
        gap = _point_distance(centre, boxes[index])
        if gap < best:
            best, likely = gap, index
    best = math.inf
    for turn in range(boxes.shape[0]):
        index = (likely + turn) % boxes.shape[0]
        if _point_distance(centre, boxes[index]) - reach < best:
            gap = _body_distance(centre, rotation, half, boxes[index])
            if gap < best:
                best, nearest = gap, index
    return best, nearest


@compiled
def sweep(
    p0: Vector, q0: Vector, p1: Vector, q1: Vector, half: Vector, boxes: Vector, least_m: float
) -> tuple[float, int, float]:
    """Compute the first contact of a moving body with a box, and its nearest approach to a box.

    Args:
        p0, p1: Positions (3,) at the start and the end, m.
        q0, q1: Attitudes (4,) there, body to world.
        half: Half sides of the body (3,), m.
        boxes: Boxes (n, 6), m.
        least_m: Nearest approach so far, m. The search ignores larger distances.

    Returns:
        Fraction of the motion at the first contact (infinite without contact), index of the box in
        contact (-1 without contact), and nearest approach, m, which is at most `least_m`.
    """
    reach = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    dot = q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3]
    angle = 2.0 * math.acos(min(1.0, abs(dot)))
    step = math.sqrt((p1[0] - p0[0]) ** 2 + (p1[1] - p0[1]) ** 2 + (p1[2] - p0[2]) ** 2)
    travel = step + angle * reach
    first, touched = math.inf, -1
    for index in range(boxes.shape[0]):
        outer = _point_distance(p0, boxes[index]) - reach - travel
        if outer <= CONTACT_M:
            share = _first_touch((p0, q0, p1, q1), half, boxes[index], travel)
            if share < first:
                first, touched = share, index
        if outer < least_m:
            least_m = _approach((p0, q0, p1, q1), half, boxes[index], travel, least_m)
    return first, touched, 0.0 if touched >= 0 else least_m


@compiled
def _first_touch(ends: _Ends, half: Vector, box: Vector, travel: float) -> float:
    centre, rotation = np.empty(3), np.empty((3, 3))
    share = 0.0
    while True:
        _pose_at(share, ends, centre, rotation)
        gap = _body_distance(centre, rotation, half, box)
        if gap <= CONTACT_M:
            return share
        if share >= 1.0 or gap > (1.0 - share) * travel:
            return math.inf
        share = min(1.0, share + gap / travel)


@compiled
def _approach(ends: _Ends, half: Vector, box: Vector, travel: float, least_m: float) -> float:
    """Return the smallest distance, m, to the box during the motion, or `least_m` if smaller."""
    centre, rotation = np.empty(3), np.empty((3, 3))
    _pose_at(0.0, ends, centre, rotation)
    first_m = _body_distance(centre, rotation, half, box)
    _pose_at(1.0, ends, centre, rotation)
    last_m = _body_distance(centre, rotation, half, box)
    least_m = min(least_m, first_m, last_m)
    intervals = np.empty((64, 4))  # a stack: both ends as shares of the motion, and the gaps there
    intervals[0] = 0.0, 1.0, first_m, last_m
    waiting = 1
    while waiting > 0:
        waiting -= 1
        low, high, gap_low, gap_high = intervals[waiting]
        bound = 0.5 * (gap_low + gap_high - travel * (high - low))
        if bound >= least_m - APPROACH_TOLERANCE_M or waiting > 60:
            continue
        middle = 0.5 * (low + high)
        _pose_at(middle, ends, centre, rotation)
        gap = _body_distance(centre, rotation, half, box)
        least_m = min(least_m, gap)
        intervals[waiting] = low, middle, gap_low, gap
        intervals[waiting + 1] = middle, high, gap, gap_high
        waiting += 2
    return least_m
