"""Renders the planar depth of a world of boxes as an 8-bit image.

The model is a pinhole camera with square pixels that looks along its forward axis, like AirSim's
DepthPlanner in MAVBench. Depth is measured along the optical axis and rounded down to 0.1 m per
grey level. The level 255 (25.5 m) means that nothing is in range.

The ray of pixel (row, column) passes through the pixel's centre. In the camera frame (forward,
left, up), with focal length f = (columns / 2) / tan(hfov / 2) in pixels:

    direction = (1, (columns / 2 - column - 0.5) / f, (rows / 2 - row - 0.5) / f)

so the ray's parameter is the planar depth.

Each box is projected first. The projection of its part in front of the camera bounds the pixels
that can see it. Only these are tested, so the cost of a frame depends on the visible boxes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.frames import Vector, rotation_matrix

LEVELS_PER_M = 10.0
NOTHING = 255
_MAX_RANGE_M = 25.5

_NEAR_M = 1e-6
_TOUCHING_M = 1e-3
_EDGES = np.array(
    [[a, a | bit] for bit in (1, 2, 4) for a in range(8) if not a & bit], dtype=np.int64
)  # (12, 2) pairs of corners that share an edge; bit 0 is x, 1 is y, 2 is z


Image = NDArray[np.uint8]


def render_depth(
    boxes_enu_m: Vector,
    position_enu_m: Vector,
    quaternion_flu_enu: Vector,
    columns: int,
    rows: int,
    hfov_rad: float,
) -> Image:
    """Render the depth image seen from a pose, as a uint8 array of shape (rows, columns).

    A grey level is 0.1 m of depth, and 255 means that nothing is in range.

    Args:
        boxes_enu_m: Boxes (n, 6) xmin ymin zmin xmax ymax zmax. The ground z = 0 always exists.
        position_enu_m: Optical centre (3,). If it is inside a box, the depth is zero everywhere; if
            it is below the ground, the depth is zero along every ray that points down. If the pose
            is not finite, all pixels are 255.
        quaternion_flu_enu: Unit quaternion (4,) w x y z, camera forward-left-up to ENU.
        columns, rows: Size of the image, at least 1.
        hfov_rad: Horizontal field of view, between 0 and pi.
    """
    focal_px = columns / 2.0 / math.tan(hfov_rad / 2.0)
    depth = np.empty((rows, columns))
    image = np.empty((rows, columns), dtype=np.uint8)
    boxes = np.ascontiguousarray(boxes_enu_m, dtype=np.float64)
    rotation = rotation_matrix(quaternion_flu_enu)
    _render(boxes, position_enu_m, rotation, focal_px, depth, image)
    return image


@compiled
def _render(
    boxes: Vector,
    position: Vector,
    rotation: Vector,
    focal_px: float,
    depth: Vector,
    image: Image,
) -> None:
    if not np.isfinite(position).all() or not np.isfinite(rotation).all():
        image[:] = NOTHING
        return
    _ground(position, rotation, focal_px, depth)
    corners = np.empty((8, 3))
    window = np.empty(4, np.int64)
    for box in range(boxes.shape[0]):
        _corners_in_camera(boxes[box], position, rotation, corners)
        if _touches(boxes[box], position):
            window[:] = 0
            window[1], window[3] = depth.shape
        elif corners[:, 0].max() < 0.0 or corners[:, 0].min() > _MAX_RANGE_M:
            continue
        else:
            _window(corners, focal_px, depth.shape, window)
        _paint(boxes[box], position, rotation, focal_px, window, depth)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            level = math.inf
            if depth[row, column] < _MAX_RANGE_M:
                level = math.floor(depth[row, column] * LEVELS_PER_M)
            image[row, column] = NOTHING if level >= NOTHING else np.uint8(level)


@compiled
def _ground(position: Vector, rotation: Vector, focal_px: float, depth: Vector) -> None:
    rows, columns = depth.shape
    for row in range(rows):
        up = (rows / 2.0 - row - 0.5) / focal_px
        for column in range(columns):
            left = (columns / 2.0 - column - 0.5) / focal_px
            dz = rotation[2, 0] + rotation[2, 1] * left + rotation[2, 2] * up
            depth[row, column] = max(0.0, position[2]) / -dz if dz < 0.0 else math.inf


@compiled
def _corners_in_camera(box: Vector, position: Vector, rotation: Vector, corners: Vector) -> None:
    for corner in range(8):
        x = box[3 if corner & 1 else 0] - position[0]
        y = box[4 if corner & 2 else 1] - position[1]
        z = box[5 if corner & 4 else 2] - position[2]
        for axis in range(3):
            corners[corner, axis] = (
                rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis] * z
            )


@compiled
def _touches(box: Vector, position: Vector) -> bool:
    """Return True if the optical centre is inside the box or too close to it for a projection."""
    for axis in range(3):
        if position[axis] < box[axis] - _TOUCHING_M or position[axis] > box[axis + 3] + _TOUCHING_M:
            return False
    return True


@compiled
def _window(
    corners: Vector, focal_px: float, shape: tuple[int, int], window: NDArray[np.int64]
) -> None:
    """Write to `window` the first row, end row, first column and end column that can see a box.

    They include a margin of 1 pixel. The part of the box beyond the near plane is convex. Its
    vertices are the corners beyond that plane and the points where edges cross it, so their
    projections bound it.
    """
    rows, columns = shape
    top, bottom, first, last = math.inf, -math.inf, math.inf, -math.inf
    for edge in range(_EDGES.shape[0]):
        a, b = corners[_EDGES[edge, 0]], corners[_EDGES[edge, 1]]
        if a[0] < _NEAR_M and b[0] < _NEAR_M:
            continue
        for end in range(2):
            here, there = (a, b) if end == 0 else (b, a)
            forward, left, up = here[0], here[1], here[2]
            if forward < _NEAR_M:
                share = (_NEAR_M - forward) / (there[0] - forward)
                left += share * (there[1] - left)
                up += share * (there[2] - up)
                forward = _NEAR_M
            column = columns / 2.0 - focal_px * left / forward
            row = rows / 2.0 - focal_px * up / forward
            first, last = min(first, column), max(last, column)
            top, bottom = min(top, row), max(bottom, row)
    window[0] = int(min(max(top - 1.0, 0.0), rows))
    window[1] = int(min(max(bottom + 2.0, 0.0), rows))
    window[2] = int(min(max(first - 1.0, 0.0), columns))
    window[3] = int(min(max(last + 2.0, 0.0), columns))


@compiled
def _paint(
    box: Vector,
    position: Vector,
    rotation: Vector,
    focal_px: float,
    window: NDArray[np.int64],
    depth: Vector,
) -> None:
    rows, columns = depth.shape
    for row in range(window[0], window[1]):
        up = (rows / 2.0 - row - 0.5) / focal_px
        for column in range(window[2], window[3]):
            left = (columns / 2.0 - column - 0.5) / focal_px
            enter, leave = 0.0, depth[row, column]
            for axis in range(3):
                slope = rotation[axis, 0] + rotation[axis, 1] * left + rotation[axis, 2] * up
                below, above = box[axis] - position[axis], box[axis + 3] - position[axis]
                if slope == 0.0:
                    if below > 0.0 or above < 0.0:
                        enter = math.inf
                        break
                    continue
                near, far = below / slope, above / slope
                if slope < 0.0:
                    near, far = far, near
                enter, leave = max(enter, near), min(leave, far)
                if enter > leave:
                    break
            if enter <= leave and enter < depth[row, column]:
                depth[row, column] = enter
