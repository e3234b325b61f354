"""OctoMap: log-odds occupancy of the world in an octree, and immutable snapshots of it.

The tree is OctoMap's own C++ (pyoctomap), so a fault in it is a fault in OctoMap. Defaults are
those of MAVBench's octomap_server, except the resolution; see `OccupancyParams`.

A snapshot is OctoMap's binary node stream; see `octree`. A voxel's Morton code interleaves the bits
of its indices (x lowest), so sorted codes are in the stream's order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyoctomap
from numpy.typing import NDArray

from mavfi_cli.autonomy.octree import HALF_RANGE, TREE_DEPTH
from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray, PointCloud

Codes = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class OccupancyParams:
    """OctoMap's sensor model (Hornung et al. 2013) as octomap_server ships it.

    MAVBench maps at 0.1 m. The default here is 0.2 m, about the spacing of neighbouring rays of a
    64-column, 90-degree image at full range. Finer voxels would leave holes in the map.
    """

    resolution_m: float = 0.2
    max_range_m: float = 7.0
    probability_hit: float = 0.7
    probability_miss: float = 0.4
    clamp_min: float = 0.12
    clamp_max: float = 0.97
    occupancy_threshold: float = 0.5
    z_min_m: float = -2.0  # points below z_min_m or above z_max_m are ignored
    z_max_m: float = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSnapshot:
    """The occupied voxels of the map at one moment, in OctoMap's `.bt` format."""

    stamp_s: float
    resolution_m: float
    payload: bytes  # node stream after the header's `data` line; empty for an empty map

    @classmethod
    def empty(cls, resolution_m: float = 0.2) -> MapSnapshot:
        """Return the snapshot of an empty map."""
        return cls(stamp_s=-math.inf, resolution_m=resolution_m, payload=b"")

    @classmethod
    def of_points(cls, points_enu_m: FloatArray, resolution_m: float = 0.2) -> MapSnapshot:
        """Return a snapshot in which exactly the voxels of the points (n, 3) are occupied."""
        payload = _stream_of(np.unique(_codes_of(points_enu_m, resolution_m)))
        return cls(stamp_s=0.0, resolution_m=resolution_m, payload=payload)

    def signed_bytes(self) -> NDArray[np.int8]:
        """Return the payload (n,) in the type that `fcl.OcTree` takes."""
        return np.frombuffer(self.payload, np.int8)


class OccupancyMap:
    """An octree that integrates point clouds, with a list of its occupied voxels.

    A voxel can be occupied only if a ray has ended in it. The map keeps a list of these voxels and,
    after each cloud, looks up in the tree those that the cloud may have changed. This makes a
    snapshot cheap. OctoMap's own binary export visits every free node. It also replaces the tree's
    probabilities by their extremes, so that a new obstacle in cleared space would need several
    observations. Inner nodes are never updated, because nothing reads them.
    """

    def __init__(self, params: OccupancyParams) -> None:
        self._params = params
        self._stamp_s = -math.inf
        self._ended_in: Codes = np.empty(0, np.int64)  # sorted
        self._occupied = np.empty(0, np.bool_)  # one flag for each code in _ended_in
        self._tree = pyoctomap.OcTree(params.resolution_m)
        self._tree.setProbHit(params.probability_hit)
        self._tree.setProbMiss(params.probability_miss)
        self._tree.setClampingThresMin(params.clamp_min)
        self._tree.setClampingThresMax(params.clamp_max)
        self._tree.setOccupancyThres(params.occupancy_threshold)

    def insert(self, cloud: PointCloud) -> None:
        """Integrate one cloud: rays clear voxels, and end points in range mark theirs as occupied.

        Points that are not finite, out of the octree's range or outside the height limits are
        ignored. A cloud whose origin is not finite or out of that range is ignored entirely.
        """
        self._stamp_s = cloud.stamp_s
        points = self._usable(cloud.points_enu_m)
        origin = np.asarray(cloud.origin_enu_m, np.float64)
        if not len(points) or not self._in_range(origin).all():
            return
        self._tree.insertPointCloud(
            points, origin, max_range=self._params.max_range_m, lazy_eval=True
        )
        reach = self._params.max_range_m + self._params.resolution_m
        ends = points[((points - origin) ** 2).sum(axis=1) <= reach**2]
        self._remember(ends)
        low = np.minimum(points.min(axis=0), origin)
        high = np.maximum(points.max(axis=0), origin)
        self._look_up(np.maximum(low, origin - reach), np.minimum(high, origin + reach))

    def snapshot(self) -> MapSnapshot:
        """Return a snapshot of the map, which later insertions do not change."""
        return MapSnapshot(
            stamp_s=self._stamp_s,
            resolution_m=self._params.resolution_m,
            payload=_stream_of(self._ended_in[self._occupied]),
        )

    def tree(self) -> bytes:
        """Return the whole tree in OctoMap's `.ot` format: every node with its log-odds value."""
        return bytes(self._tree.write())

    def _usable(self, points: FloatArray) -> FloatArray:
        height = points[:, 2]
        kept = (height >= self._params.z_min_m) & (height <= self._params.z_max_m)
        kept &= self._in_range(points).all(axis=1)
        return np.ascontiguousarray(points if kept.all() else points[kept])

    def _in_range(self, coordinates: FloatArray) -> NDArray[np.bool_]:
        """Return, for each coordinate, True if it is more than two ray lengths inside the octree.

        NaN gives False.
        """
        limit = HALF_RANGE * self._params.resolution_m - 2.0 * self._params.max_range_m
        return np.abs(coordinates) < limit

    def _remember(self, ends: FloatArray) -> None:
        """Add the voxels of ray ends (n, 3) to the list of voxels that may be occupied."""
        codes = np.unique(_codes_of(ends, self._params.resolution_m))
        places, after = (np.searchsorted(self._ended_in, codes, side) for side in ("left", "right"))
        fresh = places == after  # `setdiff1d` would sort all voxels anew
        if fresh.any():
            self._ended_in = np.insert(self._ended_in, places[fresh], codes[fresh])
            self._occupied = np.insert(self._occupied, places[fresh], False)

    def _look_up(self, low: FloatArray, high: FloatArray) -> None:
        """Update the occupancy of all listed voxels in the box from low to high, each (3,)."""
        resolution = self._params.resolution_m
        centres = np.empty((len(self._ended_in), 3))
        _voxel_centres(self._ended_in, resolution, centres)
        inside = ((centres >= low - resolution) & (centres <= high + resolution)).all(axis=1)
        self._occupied[inside] = self._tree.getLabels(centres[inside]) == 1


def _codes_of(points: FloatArray, resolution_m: float) -> Codes:
    """Return the codes of the voxels that contain the points (n, 3). Omit points without a code."""
    codes = np.empty(len(points), np.int64)
    return codes[: _morton_codes(np.asarray(points, np.float64), resolution_m, codes)]


@compiled
def _morton_codes(points: FloatArray, resolution: float, codes: Codes) -> int:
    """Write the voxel codes of points (n, 3) to `codes`, and return how many were written.

    Points that are not finite or outside the octree's range have no code. Coordinates are rounded
    to single precision first, as in OctoMap.
    """
    count = 0
    factor = 1.0 / resolution
    for i in range(points.shape[0]):
        code = 0
        for axis in range(3):
            scaled = math.floor(factor * np.float64(np.float32(points[i, axis]))) + HALF_RANGE
            if not 0 <= scaled < 2 * HALF_RANGE:
                code = -1
                break
            index = int(scaled)
            for bit in range(TREE_DEPTH):
                code |= ((index >> bit) & 1) << (3 * bit + axis)
        if code >= 0:
            codes[count] = code
            count += 1
    return count


@compiled
def _voxel_centres(codes: Codes, resolution: float, centres: FloatArray) -> None:
    """Write to `centres` (n, 3) the centres, in metres, of the voxels with the codes (n,)."""
    for i in range(codes.shape[0]):
        for axis in range(3):
            index = 0
            for bit in range(TREE_DEPTH):
                index |= ((codes[i] >> (3 * bit + axis)) & 1) << bit
            centres[i, axis] = (index - HALF_RANGE + 0.5) * resolution


def _stream_of(codes: Codes) -> bytes:
    """Return the node stream of a tree in which only the given voxels are occupied.

    All other voxels are unknown. `codes` (n,) must be sorted and distinct. A fully occupied cube
    becomes one leaf.
    """
    if not len(codes):
        return b""
    stream = np.empty(2 * TREE_DEPTH * len(codes), np.uint8)
    return stream[: _encode(codes, stream)].tobytes()


@compiled
def _encode(codes: Codes, stream: NDArray[np.uint8]) -> int:
    """Write the node stream of sorted codes (n,) into `stream`, and return its size in bytes."""
    stack = np.empty((8 * TREE_DEPTH + 8, 3), np.int64)  # first code, end of codes, height
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, len(codes), TREE_DEPTH
    depth, position = 1, 0
    ends = np.empty(8, np.int64)
    while depth > 0:
        depth -= 1
        first, end, height = stack[depth, 0], stack[depth, 1], stack[depth, 2] - 1
        shift = 3 * height
        full = 1 << shift
        begin, children = first, 0
        for child in range(8):
            last = begin
            if height == 0:
                while last < end and (codes[last] & 7) == child:
                    last += 1
            else:
                bound = (((codes[first] >> (shift + 3)) << 3) + child + 1) << shift
                last = begin + np.searchsorted(codes[begin:end], bound)
            ends[child] = last
            if last > begin:
                kind = 2 if last - begin == full else 3
                children |= kind << (2 * child)
            begin = last
        stream[position], stream[position + 1] = children & 255, children >> 8
        position += 2
        for child in range(7, -1, -1):  # reversed, as the stack returns its last entry first
            if (children >> (2 * child)) & 3 == 3:
                stack[depth, 0] = ends[child - 1] if child > 0 else first
                stack[depth, 1], stack[depth, 2] = ends[child], height
                depth += 1
    return position
