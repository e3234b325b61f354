"""Exact distance between the vehicle's oriented box and axis-aligned boxes, compiled.

The shortest distance of two separate convex boxes is between a corner of one and the other box, or
between an edge of each. A separating-axis test with six face normals and nine cross products of
edges decides if they overlap (S. Gottschalk, M. Lin, D. Manocha, "OBBTree", 1996).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled

Vector = NDArray[np.float64]

_PARALLEL = 1e-12


@compiled
def point_distance(point: Vector, box: Vector) -> float:
    """Return the distance, m, of a point (3,) to an axis-aligned box (6,); zero inside."""
    total = 0.0
    for axis in range(3):
        gap = max(box[axis] - point[axis], point[axis] - box[axis + 3], 0.0)
        total += gap * gap
    return math.sqrt(total)


@compiled
def body_distance(centre: Vector, rotation: Vector, half: Vector, box: Vector) -> float:
    """Return the distance, m, of an oriented box to an axis-aligned one; zero if they overlap.

    The oriented box has a centre (3,) in the world, half sides (3,), and a rotation (3, 3) from
    body to world. The other is (6,) xmin ymin zmin xmax ymax zmax.
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
    """Return the squared distance of one body edge (along body `axis`) to one box edge.

    With r the offset of the edges' midpoints, u and v their directions and h, k their half
    lengths, |r + s u - t v| is minimal where both derivatives vanish. The solution is clamped to
    the segments one after the other. The ends of edges are corners, which are handled separately,
    so only an interior minimum must be exact.
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
