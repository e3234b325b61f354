"""The map: hits fill, rays clear, and the snapshot is OctoMap's own verdict."""

import math

import numpy as np
import pyoctomap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.autonomy.occupancy import (
    MapSnapshot,
    OccupancyMap,
    OccupancyParams,
)
from mavfi_cli.autonomy.octree import occupied_leaves
from mavfi_cli.core.types import PointCloud

ORIGIN = np.array([0.05, 0.05, 5.05])


def cloud_of(points, origin=ORIGIN, stamp_s=1.0):
    return PointCloud(
        stamp_s=stamp_s, points_enu_m=np.asarray(points, np.float64), origin_enu_m=origin
    )


def voxels(snapshot):
    return {
        (x + i, y + j, z + k)
        for x, y, z, size in occupied_leaves(snapshot.payload).tolist()
        for i in range(size)
        for j in range(size)
        for k in range(size)
    }


def moving_clouds(count=12, seed=0):
    """Clouds of a cluttered space, from a sensor that moves; some rays without return."""
    rng = np.random.default_rng(seed)
    for step in range(count):
        origin = ORIGIN + np.array([0.3 * step, 0.0, 0.0])
        directions = rng.normal(size=(300, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        length = rng.choice([2.0, 4.0, 6.5, 7.5], 300)[:, None]
        yield cloud_of(origin + directions * length, origin, stamp_s=0.3 * step)


def test_the_snapshot_agrees_with_a_tree_that_octomap_keeps_by_itself():
    params = OccupancyParams(z_min_m=-100.0)
    ours = OccupancyMap(params)
    tree = pyoctomap.OcTree(params.resolution_m)
    tree.setProbHit(0.7)
    tree.setProbMiss(0.4)
    tree.setClampingThresMin(0.12)
    tree.setClampingThresMax(0.97)
    for cloud in moving_clouds():
        ours.insert(cloud)
        ours.snapshot()
        tree.insertPointCloud(cloud.points_enu_m, cloud.origin_enu_m, max_range=7.0)
    expected = set()
    for leaf in tree.begin_leafs():
        if tree.isNodeOccupied(leaf):
            size = round(leaf.getSize() / params.resolution_m)
            corner = np.array(leaf.getCoordinate()) / params.resolution_m - size / 2
            low = np.round(corner).astype(int)
            expected |= {tuple((low + i).tolist()) for i in np.ndindex(size, size, size)}
    assert len(expected) > 500
    assert voxels(ours.snapshot()) == expected


def test_the_same_clouds_give_the_same_bytes():
    def flown():
        occupancy = OccupancyMap(OccupancyParams())
        for cloud in moving_clouds():
            occupancy.insert(cloud)
        return occupancy.snapshot()

    assert flown() == flown()


def test_a_point_in_range_fills_its_voxel_and_one_beyond_fills_none():
    occupancy = OccupancyMap(OccupancyParams())
    occupancy.insert(cloud_of([[3.05, 0.05, 5.05], [8.0, 0.0, 5.0]]))
    assert voxels(occupancy.snapshot()) == {(15, 0, 25)}
    assert len(voxels(occupancy.snapshot())) == 1


indices = st.integers(-30000, 30000)


@settings(max_examples=30, deadline=None)
@given(indices, indices, indices)
def test_a_voxel_is_found_again_wherever_it_is(i, j, k):
    """Its code, its centre, and OctoMap's own look-up agree all over the tree's range."""
    centre = (np.array([i, j, k]) + 0.5) * 0.2
    occupancy = OccupancyMap(OccupancyParams(z_min_m=-1e4, z_max_m=1e4))
    occupancy.insert(cloud_of([centre], origin=centre + np.array([1.0, 0.0, 0.0])))
    assert voxels(occupancy.snapshot()) == {(i, j, k)}


def test_rays_through_a_wrong_voxel_clear_it_and_snapshots_stay_as_they_were():
    occupancy = OccupancyMap(OccupancyParams())
    occupancy.insert(cloud_of([[3.05, 0.05, 5.05]]))
    before = occupancy.snapshot()
    # One hit is ln(0.7/0.3) = 0.85, a miss ln(0.4/0.6) = -0.41: the third miss clears.
    for misses, occupied in [(1, True), (2, True), (3, False)]:
        occupancy.insert(cloud_of([[6.05, 0.05, 5.05]], stamp_s=1.0 + misses))
        assert ((15, 0, 25) in voxels(occupancy.snapshot())) is occupied
    assert voxels(before) == {(15, 0, 25)}


def test_taking_snapshots_does_not_change_the_map():
    """OctoMap's own binary export would: it drives every probability to its extreme."""
    watched, unwatched = OccupancyMap(OccupancyParams()), OccupancyMap(OccupancyParams())
    for cloud in moving_clouds():
        watched.insert(cloud)
        watched.snapshot()
        unwatched.insert(cloud)
    assert watched.snapshot() == unwatched.snapshot()


def test_the_height_limits_drop_points():
    occupancy = OccupancyMap(OccupancyParams(z_min_m=4.0, z_max_m=6.0))
    occupancy.insert(cloud_of([[3, 0, 5], [3, 0, 3.5], [3, 0, 6.5]]))
    assert len(voxels(occupancy.snapshot())) == 1


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300, 1e9])
def test_corrupted_points_and_origins_are_ignored(bad):
    occupancy = OccupancyMap(OccupancyParams())
    occupancy.insert(cloud_of([[3, 0, 5], [bad, 0, 5], [0, 0, bad]]))
    assert len(voxels(occupancy.snapshot())) == 1
    occupancy.insert(cloud_of([[4, 0, 5]], origin=np.array([0.0, bad, 0.0])))
    assert len(voxels(occupancy.snapshot())) == 1


def test_an_empty_map_has_no_occupied_voxels():
    assert voxels(MapSnapshot.empty()) == set()
    assert OccupancyMap(OccupancyParams()).snapshot().payload == b""


def test_a_map_can_be_made_of_points():
    assert voxels(MapSnapshot.of_points([[0.1, 0.1, 0.1], [0.15, 0.1, 0.1], [1.1, -0.1, 0.1]])) == {
        (0, 0, 0),
        (5, -1, 0),
    }
