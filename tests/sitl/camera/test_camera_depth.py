from __future__ import annotations

import math

import fcl
import numpy as np
import pytest
from numpy.typing import NDArray

from mavfi_cli.core.frames import quaternion_from_euler, rotation_matrix
from sitl.camera.depth import render_depth
from sitl.world import load_world

NONE = np.zeros((0, 6))
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
HFOV = math.pi / 2.0


def directions(quaternion: NDArray, columns: int, rows: int, hfov: float) -> NDArray:
    """World rays (3, rows, columns) with forward component one in the camera."""
    focal = columns / 2.0 / math.tan(hfov / 2.0)
    left = ((columns / 2.0 - np.arange(columns) - 0.5) / focal)[None, :]
    up = ((rows / 2.0 - np.arange(rows) - 0.5) / focal)[:, None]
    r = rotation_matrix(quaternion)
    return np.stack([r[a, 0] + r[a, 1] * left + r[a, 2] * up for a in range(3)])


def twin(
    boxes: NDArray, position: NDArray, quaternion: NDArray, columns: int, rows: int, hfov: float
) -> NDArray[np.uint8]:
    """Every ray against every box, in plain numpy."""
    d = directions(quaternion, columns, rows, hfov)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = np.where(d[2] < 0.0, max(0.0, position[2]) / -d[2], np.inf)
        for box in boxes:
            enter, leave = np.zeros((rows, columns)), np.full((rows, columns), np.inf)
            for a in range(3):
                ends = [(box[a] - position[a]) / d[a], (box[a + 3] - position[a]) / d[a]]
                beside = box[a] > position[a] or box[a + 3] < position[a]
                along = d[a] == 0.0
                near = np.where(along, np.inf if beside else -np.inf, np.minimum(*ends))
                far = np.where(along, np.inf, np.maximum(*ends))
                enter, leave = np.maximum(enter, near), np.minimum(leave, far)
            depth = np.where(enter <= leave, np.minimum(depth, enter), depth)
        levels = np.minimum(np.floor(depth * 10.0), 255.0)
    return np.where(depth < 25.5, levels, 255.0).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(64, 48), (1, 1), (7, 90), (256, 144)])
@pytest.mark.parametrize("world", ["dense", "factory", "farm"])
def test_bit_equal_to_numpy(world: str, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(size[0])
    for seed in range(25):
        boxes = load_world(world, seed=seed).boxes_enu_m
        position = rng.uniform([-20, -20, -0.5], [60, 60, 12])
        reach = 3.0 if seed % 2 else 0.3
        quaternion = quaternion_from_euler(*rng.uniform(-reach, reach, 2), rng.uniform(-3, 3))
        hfov = rng.uniform(0.3, 2.6)
        image = render_depth(boxes, position, quaternion, *size, hfov)
        assert np.array_equal(image, twin(boxes, position, quaternion, *size, hfov))


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2.0, math.pi, -math.pi / 2.0])
def test_bit_equal_to_numpy_along_the_axes_and_on_faces(yaw: float) -> None:
    rng = np.random.default_rng(1)
    quaternion = np.array([math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)])
    boxes = np.array([[-3, -3, 0, -2, 3, 9], [2, -3, 0, 3, 3, 9], [-1, 2, 3, 1, 4, 5.0]])
    for _ in range(40):
        position = np.round(rng.uniform(-4, 4, 3))
        image = render_depth(boxes, position, quaternion, 33, 25, HFOV)
        assert np.array_equal(image, twin(boxes, position, quaternion, 33, 25, HFOV))


def test_a_wall_ahead_has_the_same_planar_depth_in_every_pixel() -> None:
    wall = np.array([[12.34, -500, -500, 13, 500, 500.0]])
    image = render_depth(wall, np.array([0, 0, 300.0]), LEVEL, 64, 48, HFOV)
    assert (image == 123).all()


def test_the_ground_by_its_closed_form() -> None:
    height, pitch_down = 5.0, math.radians(30.0)
    quaternion = quaternion_from_euler(0.0, pitch_down, 1.0)
    image = render_depth(NONE, np.array([3, 4, height]), quaternion, 64, 48, HFOV)
    up = (24 - np.arange(48) - 0.5) / 32.0
    fall = math.sin(pitch_down) - up * math.cos(pitch_down)
    depth = np.where(fall > 0.0, height / np.where(fall > 0.0, fall, 1.0), np.inf)
    expected = np.where(depth < 25.5, np.floor(depth * 10.0), 255.0)
    assert (image == expected[:, None]).all()


def test_left_is_left_and_up_is_up() -> None:
    post = np.array([[9.95, 4.9, 102.9, 10.1, 5.1, 103.1]])  # 10 ahead, 5 left, 3 above
    image = render_depth(post, np.array([0, 0, 100.0]), LEVEL, 640, 480, HFOV)
    rows, columns = np.nonzero(image == 99)
    assert columns.mean() == pytest.approx(320 - 0.5 * 320, abs=2.0)
    assert rows.mean() == pytest.approx(240 - 0.3 * 320, abs=2.0)


def test_depth_agrees_with_fcl_along_the_rays() -> None:
    """A ray as a thin rod that ends just before the hit touches nothing, just behind it does."""
    boxes = load_world("factory", seed=0).boxes_enu_m
    solids = [
        fcl.CollisionObject(fcl.Box(*(b[3:] - b[:3])), fcl.Transform((b[:3] + b[3:]) / 2.0))
        for b in boxes
    ]
    manager = fcl.DynamicAABBTreeCollisionManager()
    manager.registerObjects(solids)
    manager.setup()
    position, quaternion = np.array([22.0, 20.0, 6.0]), quaternion_from_euler(0.1, -0.1, 1.3)
    image = render_depth(boxes, position, quaternion, 16, 12, HFOV)
    rays = directions(quaternion, 16, 12, HFOV)
    checked = 0
    for row, column in np.ndindex(image.shape):
        ray, level = rays[:, row, column], int(image[row, column])
        if level == 255 or position[2] + ray[2] * (level + 1) / 10.0 <= 0.0:
            continue
        for depth, hit in ((level / 10.0 - 0.01, False), ((level + 1) / 10.0 + 0.01, True)):
            data = fcl.CollisionData()
            manager.collide(_rod(position, ray * depth), data, fcl.defaultCollisionCallback)
            assert data.result.is_collision == hit
        checked += 1
    assert checked > 50


def _rod(start: NDArray, along: NDArray) -> fcl.CollisionObject:
    length = float(np.linalg.norm(along))
    z = along / length
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(z, x), z])
    rod = fcl.Box(1e-6, 1e-6, length)
    return fcl.CollisionObject(rod, fcl.Transform(rotation, start + along / 2.0))


def test_inside_a_box_everything_is_at_zero() -> None:
    box = np.array([[-1, -1, 0, 1, 1, 9.0]])
    assert not render_depth(box, np.array([0, 0, 5.0]), LEVEL, 8, 6, HFOV).any()


@pytest.mark.parametrize(("away_m", "level"), [(10.05, 100), (25.45, 254), (25.5, 255), (40, 255)])
def test_the_range_ends_at_the_last_level(away_m: float, level: int) -> None:
    wall = np.array([[away_m, -500, -500, 50, 500, 500.0]])
    up = np.array([0, 0, 300.0])
    assert (render_depth(wall, up, LEVEL, 8, 6, HFOV) == level).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_a_pose_beyond_all_sense_sees_nothing_and_does_not_crash(value: float) -> None:
    boxes = load_world("dense", seed=0).boxes_enu_m
    image = render_depth(boxes, np.array([0.0, 0.0, value]), LEVEL, 64, 48, HFOV)
    assert (image == 255).all() or value < 0
