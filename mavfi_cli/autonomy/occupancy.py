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

from mavfi_cli.core.types import PointCloud


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
    """The map at one moment, as the maximum-likelihood octree of OctoMap's `.bt` format."""

    stamp_s: float
    resolution_m: float
    payload: bytes  # the node stream after the header's `data` line

    def signed_bytes(self) -> NDArray[np.int8]:
        """The payload as `fcl.OcTree` takes it, (n,)."""
        return np.frombuffer(self.payload, np.int8)


class OccupancyMap:
    """An octree that integrates point clouds."""

    def __init__(self, params: OccupancyParams) -> None:
        self._params = params
        self._stamp_s = -math.inf
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

    def insert(self, cloud: PointCloud) -> None:
        """Integrate one cloud: rays clear, end points within the range fill.

        Points that are not finite are ignored, as is a whole cloud without a finite origin.
        """
        self._stamp_s = cloud.stamp_s
        points = cloud.points_enu_m
        height = points[:, 2]
        kept = (height >= self._params.z_min_m) & (height <= self._params.z_max_m)
        kept &= np.isfinite(points).all(axis=1)
        if not kept.all():
            points = points[kept]
        if not len(points) or not np.isfinite(cloud.origin_enu_m).all():
            return
        self._tree.insertPointCloud(
            np.ascontiguousarray(points),
            cloud.origin_enu_m,
            max_range=self._params.max_range_m,
            lazy_eval=True,
        )
        self._tree.updateInnerOccupancy()

    def snapshot(self) -> MapSnapshot:
        """The map as it is now; later insertions do not change it."""
        return MapSnapshot(
            stamp_s=self._stamp_s,
            resolution_m=self._params.resolution_m,
            payload=_payload(self._tree),
        )


def empty_snapshot(resolution_m: float = 0.2) -> MapSnapshot:
    """The map of a world of which nothing was seen yet."""
    return MapSnapshot(stamp_s=-math.inf, resolution_m=resolution_m, payload=b"")


def _payload(tree: pyoctomap.OcTree) -> bytes:
    if tree.size() == 0:
        return b""
    written: bytes = tree.writeBinary()
    return written.split(b"\ndata\n", 1)[1]
