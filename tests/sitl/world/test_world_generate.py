from __future__ import annotations

import numpy as np
import pytest

from mavfi_cli.core.errors import WorldError
from sitl.world import World, load_world, named_worlds
from sitl.world.world import CLEAR_RADIUS_M, distance_to_boxes

GOAL = np.array([30.0, 40.0, 5.0])
FAR_GOAL = np.array([900.0, 900.0, 5.0])


def towers(density: float, size_m: float, seed: int, *, goal: np.ndarray) -> World:
    return load_world(f"gen:{density},{size_m}", seed=seed, goal_enu_m=goal)


@pytest.mark.parametrize("density", [0.05, 0.2])
def test_share_of_occupied_cells_is_the_density(density: float) -> None:
    world = towers(density, 3.0, 7, goal=FAR_GOAL)
    width, height = (world.bounds_enu_m[3:5] - world.bounds_enu_m[:2]) / 10.0
    cells = width * height
    spread = np.sqrt(cells * density * (1.0 - density))
    assert abs(len(world.boxes_enu_m) - cells * density) < 4.0 * spread


def test_each_box_is_a_square_tower_in_the_middle_of_its_cell() -> None:
    boxes = towers(1.0, 5.0, 1, goal=GOAL).boxes_enu_m
    assert np.allclose(boxes[:, 3:5] - boxes[:, :2], 5.0)
    assert np.allclose((boxes[:, :2] + 2.5) % 10.0, 5.0)
    assert (boxes[:, 2] == 0.0).all()
    assert (boxes[:, 5] >= 900.0).all()


def test_density_one_fills_all_cells_but_those_near_start_and_goal() -> None:
    world = towers(1.0, 5.0, 1, goal=GOAL)
    # 7 x 8 cells; start and goal each lie where four cells meet: 3.54 m from towers of 5 m,
    # 2.83 m from towers of 6 m.
    assert len(world.boxes_enu_m) == 56
    wide = towers(1.0, 6.0, 1, goal=GOAL)
    assert len(wide.boxes_enu_m) == 56 - 8


def test_evaluation_and_training_worlds_differ() -> None:
    trained = load_world("train-0.2-5", seed=3).boxes_enu_m
    assert not np.array_equal(trained, load_world("dense", seed=3).boxes_enu_m)


def test_named_worlds_are_the_papers_pairs() -> None:
    cells = "of the 10 x 10 m cells"
    towers = {(d, s): f"towers of {s} x {s} m in {d} % {cells}" for d in (5, 20) for s in (3, 5)}
    assert {name: text for name, text in named_worlds().items() if "towers" in text} == {
        "sparse": towers[5, 3],
        "dense": towers[20, 5],
        "train-0.05-3": f"to train detectors on: {towers[5, 3]}",
        "train-0.05-5": f"to train detectors on: {towers[5, 5]}",
        "train-0.2-3": f"to train detectors on: {towers[20, 3]}",
        "train-0.2-5": f"to train detectors on: {towers[20, 5]}",
    }


def test_a_spec_gives_the_same_boxes_as_the_name() -> None:
    spec, named = load_world("gen:0.2,5", seed=4), load_world("dense", seed=4)
    assert np.array_equal(spec.boxes_enu_m, named.boxes_enu_m)


def test_start_and_goal_stay_clear_wherever_they_are() -> None:
    goal = np.array([15.0, 15.0, 5.0])  # the middle of a cell
    world = towers(1.0, 10.0, 1, goal=goal)
    assert distance_to_boxes(world.boxes_enu_m, goal, plan=True).min() >= CLEAR_RADIUS_M


@pytest.mark.parametrize(("density", "size"), [(-0.1, 3), (1.1, 3), (0.2, 0), (0.2, 11)])
def test_numbers_that_make_no_world_are_refused(density: float, size: float) -> None:
    with pytest.raises(WorldError):
        towers(density, size, 1, goal=GOAL)


def test_start_and_goal_too_far_apart_are_refused() -> None:
    with pytest.raises(WorldError, match="1000 m"):
        load_world("dense", seed=0, goal_enu_m=(5000, 0, 5))
