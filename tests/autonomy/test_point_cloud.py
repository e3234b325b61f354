"""Back-projection against a numpy twin, and against the renderer's own rays."""

import math

import numpy as np
import pytest

from mavfi_cli.autonomy.point_cloud import PointCloudParams, generate
from mavfi_cli.core.frames import quaternion_from_euler, rotation_matrix
from mavfi_cli.core.types import DepthFrame
from sitl.camera.depth import render_depth

ALL_RAYS = PointCloudParams(max_range_m=7.0, free_stride=1)


def frame_of(depth_m, quaternion=(1.0, 0.0, 0.0, 0.0), position=(1.0, 2.0, 5.0)):
    return DepthFrame(
        stamp_s=3.0,
        depth_m=np.asarray(depth_m, np.float64),
        hfov_rad=math.pi / 2,
        position_enu_m=np.array(position),
        quaternion=np.array(quaternion),
    )


def twin(frame):
    rows, columns = frame.depth_m.shape
    focal = columns / (2 * math.tan(frame.hfov_rad / 2))
    row, column = np.mgrid[0:rows, 0:columns]
    rays = np.stack(
        [
            np.ones((rows, columns)),
            -(column + 0.5 - columns / 2) / focal,
            -(row + 0.5 - rows / 2) / focal,
        ],
        axis=-1,
    )
    camera = (rays * frame.depth_m[..., None]).reshape(-1, 3)
    return frame.position_enu_m + camera @ rotation_matrix(frame.quaternion).T


def test_every_pixel_in_range_is_where_numpy_puts_it():
    rng = np.random.default_rng(1)
    frame = frame_of(rng.uniform(0.5, 3.0, (12, 16)), quaternion_from_euler(0.1, -0.2, 2.5))
    cloud = generate(frame, ALL_RAYS)
    np.testing.assert_allclose(cloud.points_enu_m, twin(frame), atol=1e-12)
    assert cloud.stamp_s == frame.stamp_s
    np.testing.assert_array_equal(cloud.origin_enu_m, frame.position_enu_m)


def test_points_of_a_rendered_wall_lie_on_the_wall():
    wall = np.array([[5.0, -20.0, -20.0, 6.0, 20.0, 30.0]])
    pose, attitude = np.array([0.0, 0.0, 5.0]), quaternion_from_euler(0.0, 0.0, 0.3)
    levels = render_depth(wall, pose, attitude, 64, 48, math.pi / 2)
    frame = frame_of(np.where(levels == 255, np.inf, levels * 0.1), attitude, pose)
    cloud = generate(frame, PointCloudParams(max_range_m=30.0, free_stride=1))
    # Depth is rounded down by up to a level; ground pixels lie below.
    on_wall = cloud.points_enu_m[cloud.points_enu_m[:, 2] > 0.5]
    assert len(on_wall) > 1000
    assert (on_wall[:, 0] <= 5.0 + 1e-9).all()
    assert (on_wall[:, 0] > 5.0 - 0.1 * 1.7).all()


def test_far_pixels_become_clearing_rays_that_end_beyond_the_range():
    frame = frame_of(np.full((8, 8), 20.0))
    cloud = generate(frame, ALL_RAYS)
    length = np.linalg.norm(cloud.points_enu_m - cloud.origin_enu_m, axis=1)
    np.testing.assert_allclose(length, 7.5)


@pytest.mark.parametrize(("stride", "expected"), [(1, 64 * 48), (2, 32 * 24), (4, 16 * 12)])
def test_only_clearing_rays_are_thinned_out(stride, expected):
    params = PointCloudParams(free_stride=stride)
    assert len(generate(frame_of(np.full((48, 64), np.inf)), params).points_enu_m) == expected
    assert len(generate(frame_of(np.full((48, 64), 3.0)), params).points_enu_m) == 64 * 48


@pytest.mark.parametrize("bad", [math.nan, -1.0, 0.0, -math.inf])
def test_senseless_depth_is_dropped(bad):
    depth = np.full((6, 6), 2.0)
    depth[2, 3] = bad
    cloud = generate(frame_of(depth), ALL_RAYS)
    assert len(cloud.points_enu_m) == 35
    assert np.isfinite(cloud.points_enu_m).all()
