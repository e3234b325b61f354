"""OctoMap: log-odds occupancy of the world in an octree, and immutable snapshots of it.

The tree is OctoMap's own C++ (pyoctomap), so a fault in it is a fault in OctoMap. Defaults are
those of the reference's octomap_server, except the resolution; see `OccupancyParams`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyoctomap
from numpy.typing import NDArray

from mavfi_cli.autonomy import octree
from mavfi_cli.core.types import FloatArray, PointCloud


@dataclass(frozen=True, slots=True, kw_only=True)
class OccupancyParams:
    """OctoMap's sensor model (Hornung et al. 2013) as octomap_server ships it.

    The reference maps at 0.1 m; the default here is 0.2 m, about the spacing of neighbouring
    rays of a 64-column, 90-degree image at full range: finer voxels would be left with holes.
    """

    resolution_m: float = 0.2
    max_range_m: float = 7.0
    probability_hit: float = 0.7
    probability_miss: float = 0.4
    clamp_min: float = 0.12
    clamp_max: float = 0.97
    occupancy_threshold: float = 0.5
    z_min_m: float = -2.0  # points below or above are ignored
    z_max_m: float = 100.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=True)
class MapSnapshot:
    """The map at one moment, as the occupied voxels in OctoMap's `.bt` format."""

    stamp_s: float
    resolution_m: float
    payload: bytes  # the node stream that follows the header's `data` line; empty: nothing known

    def signed_bytes(self) -> NDArray[np.int8]:
        """The payload as `fcl.OcTree` takes it, (n,)."""
        return np.frombuffer(self.payload, np.int8)


class OccupancyMap:
    """An octree that integrates point clouds, and which of its voxels are occupied.

    Only a voxel that some ray has ended in can be occupied, so these are remembered, and those
    that a cloud may have changed are looked up in the tree after it. That makes a snapshot cheap:
    OctoMap's own binary export would have to visit every free node, and, worse, replaces the
    tree's probabilities by their extremes, after which a new obstacle in cleared space needs
    several sightings. For the same reason inner nodes are never summed up: nobody asks them.
    """

    def __init__(self, params: OccupancyParams) -> None:
        self._params = params
        self._stamp_s = -math.inf
        self._ended_in: octree.Codes = np.empty(0, np.int64)  # sorted
        self._occupied = np.empty(0, np.bool_)  # of each of these
        self._tree = pyoctomap.OcTree(params.resolution_m)
        self._tree.setProbHit(params.probability_hit)
        self._tree.setProbMiss(params.probability_miss)
        self._tree.setClampingThresMin(params.clamp_min)
        self._tree.setClampingThresMax(params.clamp_max)
        self._tree.setOccupancyThres(params.occupancy_threshold)

    @property
    def nodes(self) -> int:
        """How many nodes the tree has."""
        return int(self._tree.size())

    @property
    def occupied_voxels(self) -> int:
        """How many voxels are occupied."""
        return int(self._occupied.sum())

    def insert(self, cloud: PointCloud) -> None:
        """Integrate one cloud: rays clear, end points within the range fill.

        Points that are not finite, out of the octree's range or outside the height limits are
        ignored, as is a whole cloud whose origin is.
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
        """The map as it is now; later insertions do not change it."""
        return MapSnapshot(
            stamp_s=self._stamp_s,
            resolution_m=self._params.resolution_m,
            payload=octree.encode(self._ended_in[self._occupied]),
        )

    def _usable(self, points: FloatArray) -> FloatArray:
        height = points[:, 2]
        kept = (height >= self._params.z_min_m) & (height <= self._params.z_max_m)
        kept &= self._in_range(points).all(axis=1)
        return np.ascontiguousarray(points if kept.all() else points[kept])

    def _in_range(self, coordinates: FloatArray) -> NDArray[np.bool_]:
        """Which coordinates the octree can hold, with room for a ray's length; NaN is out."""
        limit = octree.HALF_RANGE * self._params.resolution_m - 2.0 * self._params.max_range_m
        inside: NDArray[np.bool_] = np.abs(coordinates) < limit
        return inside

    def _remember(self, ends: FloatArray) -> None:
        """Add the voxels of ray ends (n, 3) to those that may be occupied."""
        codes = np.empty(len(ends), np.int64)
        count = octree.morton_codes(ends, self._params.resolution_m, codes)
        fresh = np.setdiff1d(codes[:count], self._ended_in)
        if len(fresh):
            places = np.searchsorted(self._ended_in, fresh)
            self._ended_in = np.insert(self._ended_in, places, fresh)
            self._occupied = np.insert(self._occupied, places, False)

    def _look_up(self, low: FloatArray, high: FloatArray) -> None:
        """Ask the tree for the remembered voxels in the box from low to high, each (3,)."""
        resolution = self._params.resolution_m
        centres = np.empty((len(self._ended_in), 3))
        octree.voxel_centres(self._ended_in, resolution, centres)
        inside = ((centres >= low - resolution) & (centres <= high + resolution)).all(axis=1)
        self._occupied[inside] = self._tree.getLabels(centres[inside]) == 1


def empty_snapshot(resolution_m: float = 0.2) -> MapSnapshot:
    """The map of a world of which nothing was seen yet."""
    return MapSnapshot(stamp_s=-math.inf, resolution_m=resolution_m, payload=b"")


def snapshot_of(points_enu_m: FloatArray, resolution_m: float = 0.2) -> MapSnapshot:
    """A map in which exactly the voxels of the points (n, 3) are occupied."""
    codes = np.empty(len(points_enu_m), np.int64)
    count = octree.morton_codes(np.asarray(points_enu_m, np.float64), resolution_m, codes)
    payload = octree.encode(np.unique(codes[:count]))
    return MapSnapshot(stamp_s=0.0, resolution_m=resolution_m, payload=payload)
