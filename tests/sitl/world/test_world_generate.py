from __future__ import annotations

import numpy as np
import pytest

from mavfi_cli.core.errors import WorldError
from sitl.world import load_world
from sitl.world.load import GENERATED
from sitl.world.world import CLEAR_RADIUS_M, GeneratorParams, generate, plan_distance_to_boxes

START, GOAL = np.zeros(3), np.array([30.0, 40.0, 5.0])
FAR_GOAL = np.array([900.0, 900.0, 5.0])


@pytest.mark.parametrize("density", [0.05, 0.2])
def test_share_of_occupied_cells_is_the_density(density: float) -> None:
    world = generate("w", GeneratorParams(density=density, size_m=3.0), 7, START, FAR_GOAL)
    width, height = (world.bounds_enu_m[3:5] - world.bounds_enu_m[:2]) / 10.0
    cells = width * height
    spread = np.sqrt(cells * density * (1.0 - density))
    assert abs(len(world.boxes_enu_m) - cells * density) < 4.0 * spread


def test_each_box_is_a_square_tower_in_the_middle_of_its_cell() -> None:
    boxes = generate("w", GeneratorParams(density=1.0, size_m=5.0), 1, START, GOAL).boxes_enu_m
    assert np.allclose(boxes[:, 3:5] - boxes[:, :2], 5.0)
    assert np.allclose((boxes[:, :2] + 2.5) % 10.0, 5.0)
    assert (boxes[:, 2] == 0.0).all()
    assert (boxes[:, 5] >= 900.0).all()


def test_density_one_fills_all_cells_but_those_near_start_and_goal() -> None:
    world = generate("w", GeneratorParams(density=1.0, size_m=5.0), 1, START, GOAL)
    # 7 x 8 cells; start and goal each lie where four cells meet: 3.54 m from towers of 5 m,
    # 2.83 m from towers of 6 m.
    assert len(world.boxes_enu_m) == 56
    wide = generate("w", GeneratorParams(density=1.0, size_m=6.0), 1, START, GOAL)
    assert len(wide.boxes_enu_m) == 56 - 8


def test_evaluation_and_training_worlds_differ() -> None:
    trained = load_world("train-0.2-5", seed=3).boxes_enu_m
    assert not np.array_equal(trained, load_world("dense", seed=3).boxes_enu_m)


def test_named_worlds_are_the_papers_pairs() -> None:
    pairs = {name: (p.density, p.size_m) for name, p in GENERATED.items()}
    assert pairs == {
        "sparse": (0.05, 3.0),
        "dense": (0.2, 5.0),
        "train-0.05-3": (0.05, 3.0),
        "train-0.05-5": (0.05, 5.0),
        "train-0.2-3": (0.2, 3.0),
        "train-0.2-5": (0.2, 5.0),
    }


def test_a_spec_gives_the_same_boxes_as_the_name() -> None:
    spec, named = load_world("gen:0.2,5", seed=4), load_world("dense", seed=4)
    assert np.array_equal(spec.boxes_enu_m, named.boxes_enu_m)


def test_start_and_goal_stay_clear_wherever_they_are() -> None:
    goal = np.array([15.0, 15.0, 5.0])  # the middle of a cell
    world = generate("w", GeneratorParams(density=1.0, size_m=10.0), 1, START, goal)
    assert plan_distance_to_boxes(world.boxes_enu_m, goal).min() >= CLEAR_RADIUS_M


@pytest.mark.parametrize(("density", "size"), [(-0.1, 3), (1.1, 3), (0.2, 0), (0.2, 11)])
def test_numbers_that_make_no_world_are_refused(density: float, size: float) -> None:
    with pytest.raises(WorldError):
        GeneratorParams(density=density, size_m=size)


def test_start_and_goal_too_far_apart_are_refused() -> None:
    with pytest.raises(WorldError, match="1000 m"):
        load_world("dense", seed=0, goal_enu_m=(5000, 0, 5))
