from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.core.frames import quaternion_from_euler
from sitl.camera.depth import render_depth


def lengths(least: float, most: float) -> st.SearchStrategy[float]:
    """On a grid of 2^-10 m, so that moving them by whole metres rounds nothing.

    Else the camera may stand in a plane of a box before it is moved and beside it afterwards.
    """
    return st.integers(math.ceil(least * 1024), int(most * 1024)).map(lambda n: n / 1024)


metres = lengths(-30, 30)
angles = st.floats(-3.1, 3.1)
boxes = st.lists(st.tuples(metres, metres, lengths(0, 8), *[lengths(0.01, 9)] * 3), max_size=6).map(
    lambda rows: np.array([[*r[:3], *np.add(r[:3], r[3:])] for r in rows]).reshape(-1, 6)
)
poses = st.tuples(st.tuples(metres, metres, lengths(0, 12)), st.tuples(angles, angles, angles))


def render(world: np.ndarray, pose: tuple, hfov: float = math.pi / 2.0) -> np.ndarray:
    return render_depth(world, np.array(pose[0]), quaternion_from_euler(*pose[1]), 24, 18, hfov)


@given(boxes, poses)
@settings(max_examples=100, deadline=None)
def test_one_more_box_only_brings_things_nearer(world: np.ndarray, pose: tuple) -> None:
    for count in range(len(world)):
        assert (render(world[: count + 1], pose) <= render(world[:count], pose)).all()


@given(boxes, poses)
@settings(max_examples=100, deadline=None)
def test_the_order_of_the_boxes_does_not_matter(world: np.ndarray, pose: tuple) -> None:
    assert np.array_equal(render(world, pose), render(world[::-1], pose))


@given(boxes, poses)
@settings(max_examples=100, deadline=None)
def test_an_image_of_many_boxes_is_the_nearest_of_the_images_of_each(
    world: np.ndarray, pose: tuple
) -> None:
    """Culling a box away wrongly would show here, whatever else is in view."""
    alone = [render(world[i : i + 1], pose) for i in range(len(world))]
    nearest = np.min([render(world[:0], pose), *alone], axis=0)
    assert np.array_equal(render(world, pose), nearest)


@given(boxes, poses, st.integers(-3, 3), st.integers(-3, 3))
@settings(max_examples=60, deadline=None)
def test_moving_world_and_camera_together_changes_nothing_but_rounding(
    world: np.ndarray, pose: tuple, east: int, north: int
) -> None:
    shift = np.array([8.0 * east, 8.0 * north, 0.0])
    moved = render(world + np.tile(shift, 2), (np.array(pose[0]) + shift, pose[1]))
    same = render(world, pose)
    assert np.mean(np.abs(moved.astype(int) - same) > 1) < 0.02
