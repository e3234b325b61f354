from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.world import load_world
from sitl.world.world import CLEAR_RADIUS_M, distance_to_boxes

seeds = st.integers(0, 2**40)
names = st.sampled_from(["sparse", "dense", "factory", "farm", "train-0.05-5", "gen:0.6,7.5"])
places = st.tuples(st.floats(-80, 80), st.floats(-80, 80), st.floats(0, 20))


@given(names, seeds)
@settings(max_examples=40, deadline=None)
def test_the_same_seed_gives_the_same_world(name: str, seed: int) -> None:
    one, two = load_world(name, seed=seed), load_world(name, seed=seed)
    for field in ("boxes_enu_m", "bounds_enu_m", "start_enu_m", "goal_enu_m"):
        assert np.array_equal(getattr(one, field), getattr(two, field))


@given(seeds, places, places)
@settings(max_examples=40, deadline=None)
def test_moving_the_goal_moves_no_obstacle(seed: int, one: tuple, two: tuple) -> None:
    """Where both areas reach and no disc clears, the same towers stand."""
    worlds = [load_world("dense", seed=seed, goal_enu_m=goal) for goal in (one, two)]
    low = np.maximum(worlds[0].bounds_enu_m[:2], worlds[1].bounds_enu_m[:2])
    high = np.minimum(worlds[0].bounds_enu_m[3:5], worlds[1].bounds_enu_m[3:5])
    kept = []
    for world in worlds:
        boxes = world.boxes_enu_m
        common = ((boxes[:, :2] >= low) & (boxes[:, 3:5] <= high)).all(axis=1)
        for goal in (one, two):
            common &= distance_to_boxes(boxes, np.array(goal), plan=True) >= CLEAR_RADIUS_M
        kept.append({tuple(box) for box in boxes[common].tolist()})
    assert kept[0] == kept[1]


@given(names, seeds)
@settings(max_examples=40, deadline=None)
def test_start_and_goal_are_clear_and_inside(name: str, seed: int) -> None:
    world = load_world(name, seed=seed)
    for place in (world.start_enu_m, world.goal_enu_m):
        assert (place >= world.bounds_enu_m[:3]).all()
        assert (place <= world.bounds_enu_m[3:]).all()
        assert (distance_to_boxes(world.boxes_enu_m, place, plan=True) >= CLEAR_RADIUS_M).all()


@given(seeds, places)
@settings(max_examples=50, deadline=None)
def test_distance_to_a_box_is_that_to_its_nearest_point(seed: int, place: tuple) -> None:
    boxes = load_world("factory", seed=seed % 5).boxes_enu_m
    nearest = np.clip(np.array(place), boxes[:, :3], boxes[:, 3:])
    expected = np.linalg.norm(nearest - np.array(place), axis=1)
    assert np.allclose(distance_to_boxes(boxes, np.array(place)), expected)
