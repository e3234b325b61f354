"""Obstacle grid for fast segment tests: occupied voxels dilated by the planning radius.

A voxel is blocked if any point of it is closer than the radius to any point of an occupied voxel. A
path through free voxels therefore keeps at least the radius from every mapped obstacle. This margin
is at most one voxel diagonal larger than needed. Unknown space is free, as in MAVBench.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.autonomy.octree import occupied_leaves
from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray

if TYPE_CHECKING:
    from mavfi_cli.autonomy.occupancy import MapSnapshot

Blocked = NDArray[np.uint8]

MAX_VOXELS = 60_000_000  # limits the memory for a corrupted map or bound


class GridTooLarge(ValueError):
    """The obstacles of a map lie too far apart for one grid."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObstacleGrid:
    """Blocked voxels in a box around the obstacles. The rest of `bounds_enu_m` is free."""

    blocked: Blocked  # (nx, ny, nz), 1 if the vehicle's centre must not be there
    origin_enu_m: FloatArray  # (3,) lower corner of voxel (0, 0, 0)
    resolution_m: float
    bounds_enu_m: FloatArray  # (6,) xmin ymin zmin xmax ymax zmax; outside is blocked

    @classmethod
    def build(cls, snapshot: MapSnapshot, bounds_enu_m: FloatArray, radius_m: float) -> Self:
        """Build the grid of a map inside `bounds_enu_m` (6,), dilated by `radius_m`.

        Occupied voxels outside the bounds count if their dilation reaches inside. Raises
        GridTooLarge if the grid would have more than MAX_VOXELS voxels.
        """
        resolution = snapshot.resolution_m
        reach = math.ceil(radius_m / resolution) + 1
        leaves = occupied_leaves(snapshot.payload)
        low, size = _extent(leaves, bounds_enu_m, resolution, reach)
        blocked = np.zeros(tuple(size), np.uint8)
        if blocked.size and len(leaves):
            occupied = np.zeros_like(blocked)
            _rasterise(leaves, low, occupied)
            _dilate(occupied, _run_half_widths(radius_m, resolution), blocked)
        return cls(
            blocked=blocked,
            origin_enu_m=low.astype(np.float64) * resolution,
            resolution_m=resolution,
            bounds_enu_m=np.asarray(bounds_enu_m, np.float64),
        )

    def blended(self, inner: ObstacleGrid, centre_enu_m: FloatArray, radius_m: float) -> Self:
        """Return a copy whose voxels within `radius_m` of the centre (3,) are those of `inner`."""
        blocked = self.blocked.copy()
        resolution = self.resolution_m
        to_inner = np.rint((self.origin_enu_m - inner.origin_enu_m) / resolution).astype(np.int64)
        indices = np.indices(blocked.shape, sparse=True)
        centre = (centre_enu_m - self.origin_enu_m) / resolution - 0.5
        near = sum((indices[axis] - centre[axis]) ** 2 for axis in range(3))
        chosen = np.argwhere(near <= (radius_m / resolution) ** 2)
        inside = chosen + to_inner
        covered = ((inside >= 0) & (inside < inner.blocked.shape)).all(axis=1)
        values = np.zeros(len(chosen), np.uint8)
        values[covered] = inner.blocked[tuple(inside[covered].T)]
        blocked[tuple(chosen.T)] = values
        return replace(self, blocked=blocked)

    @property
    def arguments(self) -> tuple[Blocked, FloatArray, float, FloatArray]:
        """The grid in the form of the first four arguments of `segment_free` and `path_free`."""
        return self.blocked, self.origin_enu_m, self.resolution_m, self.bounds_enu_m

    def point_free(self, point_enu_m: FloatArray) -> bool:
        """Return True if the vehicle's centre may be at the point (3,)."""
        return self.segment_free(point_enu_m, point_enu_m)

    def segment_free(self, start_enu_m: FloatArray, end_enu_m: FloatArray) -> bool:
        """Return True if the vehicle's centre may fly straight from start to end, each (3,)."""
        ends = *start_enu_m.tolist(), *end_enu_m.tolist()
        return segment_free(*self.arguments, *ends)

    def path_free(self, points_enu_m: FloatArray) -> bool:
        """Return True if every segment between consecutive points (n, 3) is free."""
        return path_free(*self.arguments, np.ascontiguousarray(points_enu_m))


def _extent(
    leaves: NDArray[np.int64], bounds: FloatArray, resolution: float, reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lower voxel index (3,) and the size (3,) of the box around dilated obstacles."""
    if not len(leaves):
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    low = leaves[:, :3].min(axis=0) - reach
    high = (leaves[:, :3] + leaves[:, 3:4]).max(axis=0) + reach
    # The box extends one reach beyond the bounds, so that obstacles just outside dilate inwards.
    low = np.maximum(low, np.floor(bounds[:3] / resolution).astype(np.int64) - reach)
    high = np.minimum(high, np.ceil(bounds[3:] / resolution).astype(np.int64) + reach)
    size = np.maximum(high - low, 0)
    if float(np.prod(size.astype(np.float64))) > MAX_VOXELS:
        raise GridTooLarge(
            f"the obstacle grid must have at most {MAX_VOXELS} voxels, got {size.tolist()}"
        )
    return low, size


def _run_half_widths(radius_m: float, resolution_m: float) -> NDArray[np.int64]:
    """Return how many voxels the dilation reaches in z, for each column offset (dx, dy).

    The result is an array (w, w). It is -1 for a column that the dilation misses. An offset of k
    between two voxels leaves a gap of max(|k| - 1, 0) voxels between them.
    """
    reach = math.ceil(radius_m / resolution_m) + 1
    offsets = np.abs(np.arange(-reach, reach + 1))
    gap = np.maximum(offsets - 1, 0) * resolution_m
    distances = np.hypot(np.hypot(gap, gap[:, None]), gap[:, None, None])  # of x, y, z
    widths: NDArray[np.int64] = np.where(distances < radius_m, offsets, -1).max(axis=2)
    widths[reach, reach] = max(0, widths[reach, reach])  # the occupied voxel itself
    return widths


@compiled
def _rasterise(leaves: NDArray[np.int64], low: NDArray[np.int64], occupied: Blocked) -> None:
    """Mark every voxel of the grid that belongs to a leaf (x, y, z, size)."""
    nx, ny, nz = occupied.shape
    for i in range(leaves.shape[0]):
        x, y, z = leaves[i, 0] - low[0], leaves[i, 1] - low[1], leaves[i, 2] - low[2]
        for m in range(max(x, 0), min(x + leaves[i, 3], nx)):
            for j in range(max(y, 0), min(y + leaves[i, 3], ny)):
                for k in range(max(z, 0), min(z + leaves[i, 3], nz)):
                    occupied[m, j, k] = 1


@compiled
def _dilate(occupied: Blocked, widths: NDArray[np.int64], blocked: Blocked) -> None:
    """Mark the voxels within reach of an occupied voxel as blocked.

    Each run of occupied voxels along z is dilated into the neighbouring columns as a whole. Walls
    are upright, so a run covers a whole column, which would be many single voxels.
    """
    nx, ny, nz = occupied.shape
    reach = widths.shape[0] // 2
    for x in range(nx):
        for y in range(ny):
            z = 0
            while z < nz:
                if occupied[x, y, z] == 0:
                    z += 1
                    continue
                end = z
                while end < nz and occupied[x, y, end] == 1:
                    end += 1
                for i in range(max(x - reach, 0), min(x + reach + 1, nx)):
                    for j in range(max(y - reach, 0), min(y + reach + 1, ny)):
                        width = widths[i - x + reach, j - y + reach]
                        if width >= 0:
                            blocked[i, j, max(z - width, 0) : min(end + width, nz)] = 1
                z = end


@compiled
def segment_free(
    blocked: Blocked,
    origin: FloatArray,
    resolution: float,
    bounds: FloatArray,
    x0: float,
    y0: float,
    z0: float,
    x1: float,
    y1: float,
    z1: float,
) -> bool:
    """Return True if a straight segment stays in the bounds and meets no blocked voxel.

    The traversal visits exactly the voxels that the segment crosses (Amanatides and Woo 1987). A
    segment with an end that is not finite is not free.
    """
    # The form of the comparisons makes NaN fail.
    if not (bounds[0] <= x0 <= bounds[3] and bounds[0] <= x1 <= bounds[3]):
        return False
    if not (bounds[1] <= y0 <= bounds[4] and bounds[1] <= y1 <= bounds[4]):
        return False
    if not (bounds[2] <= z0 <= bounds[5] and bounds[2] <= z1 <= bounds[5]):
        return False
    nx, ny, nz = blocked.shape
    if nz == 0 or ny == 0 or nx == 0:
        return True
    sx, sy, sz = (
        (x0 - origin[0]) / resolution,
        (y0 - origin[1]) / resolution,
        (z0 - origin[2]) / resolution,
    )
    ex, ey, ez = (
        (x1 - origin[0]) / resolution,
        (y1 - origin[1]) / resolution,
        (z1 - origin[2]) / resolution,
    )
    i, j, k = math.floor(sx), math.floor(sy), math.floor(sz)
    steps = abs(math.floor(ex) - i) + abs(math.floor(ey) - j) + abs(math.floor(ez) - k)
    dx, dy, dz = ex - sx, ey - sy, ez - sz
    step_x, step_y, step_z = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    next_x = ((i + (dx > 0)) - sx) / dx if dx != 0.0 else math.inf
    next_y = ((j + (dy > 0)) - sy) / dy if dy != 0.0 else math.inf
    next_z = ((k + (dz > 0)) - sz) / dz if dz != 0.0 else math.inf
    delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
    delta_z = abs(1.0 / dz) if dz != 0.0 else math.inf
    for _ in range(steps + 1):
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz and blocked[i, j, k] == 1:
            return False
        if next_x <= next_y and next_x <= next_z:
            i += step_x
            next_x += delta_x
        elif next_y <= next_z:
            j += step_y
            next_y += delta_y
        else:
            k += step_z
            next_z += delta_z
    return True


@compiled
def path_free(
    blocked: Blocked,
    origin: FloatArray,
    resolution: float,
    bounds: FloatArray,
    points: FloatArray,
) -> bool:
    """Return True if every segment of a polyline (n, 3) is free; see `segment_free`."""
    for i in range(points.shape[0] - 1):
        if not segment_free(
            blocked, origin, resolution, bounds,
            points[i, 0], points[i, 1], points[i, 2],
            points[i + 1, 0], points[i + 1, 1], points[i + 1, 2],
        ):  # fmt: skip
            return False
    return True
