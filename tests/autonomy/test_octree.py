"""The node stream against OctoMap itself, read back by our decoder and by FCL."""

import fcl
import numpy as np
import pyoctomap
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.octree import occupied_leaves

RESOLUTION_M = 0.2
OCCUPIED = True


def stream_of(points):
    return MapSnapshot.of_points(np.asarray(points, np.float64), RESOLUTION_M).payload


def voxels_of(leaves):
    return {
        (x + i, y + j, z + k)
        for x, y, z, size in leaves.tolist()
        for i in range(size)
        for j in range(size)
        for k in range(size)
    }


def octomap_stream(points):
    tree = pyoctomap.OcTree(RESOLUTION_M)
    for point in points:
        tree.updateNode([float(c) for c in point], OCCUPIED)
    tree.updateInnerOccupancy()
    return tree.writeBinary().split(b"\ndata\n", 1)[1]


def test_stream_is_what_octomap_writes_for_the_same_voxels():
    points = np.random.default_rng(0).uniform(-6, 6, (400, 3))
    assert stream_of(points) == octomap_stream(points)


def test_a_full_cube_is_one_leaf_as_octomap_prunes_it():
    side = np.arange(8) * RESOLUTION_M + 0.5 * RESOLUTION_M
    points = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    stream = stream_of(points)
    assert stream == octomap_stream(points)
    assert occupied_leaves(stream).tolist() == [[0, 0, 0, 8]]


indices = st.integers(-30000, 30000)


@given(st.sets(st.tuples(indices, indices, indices), min_size=1, max_size=40))
def test_reading_gives_back_the_voxels_that_were_written(voxels):
    centres = (np.array(sorted(voxels)) + 0.5) * RESOLUTION_M
    stream = stream_of(centres)
    assert voxels_of(occupied_leaves(stream)) == voxels


@given(st.binary(max_size=400))
def test_senseless_streams_are_read_without_harm(stream):
    leaves = occupied_leaves(stream)
    assert leaves.shape[1] == 4
    assert (leaves[:, 3] >= 1).all()


def test_points_that_no_octree_holds_have_no_code():
    assert stream_of([[np.nan, 0, 0], [np.inf, 0, 0], [0, 1e9, 0], [0, 0, -1e300]]) == b""


def test_fcl_sees_the_voxel_where_it_is():
    stream = stream_of([[1.1, 2.1, 3.1]])
    tree = fcl.CollisionObject(fcl.OcTree(RESOLUTION_M, np.frombuffer(stream, np.int8)))
    for x, expected in [(1.25, True), (1.45, False), (0.95, True), (0.75, False)]:
        probe = fcl.CollisionObject(fcl.Sphere(0.1), fcl.Transform(np.array([x, 2.1, 3.1])))
        found = fcl.collide(probe, tree, fcl.CollisionRequest(), fcl.CollisionResult())
        assert bool(found) is expected
