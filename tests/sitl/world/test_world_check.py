from __future__ import annotations

import itertools

import numpy as np
import pytest

from mavfi_cli.core.errors import WorldError
from sitl.world.plan import check_world
from sitl.world.world import World, distance_to_boxes

WALL = [10.0, -20.0, 0.0, 11.0, 20.0, 20.0]


def world(*boxes: list[float], goal: tuple[float, float, float] = (20.0, 0.0, 5.0)) -> World:
    return World(
        name="w",
        seed=0,
        boxes_enu_m=np.array(boxes).reshape(-1, 6),
        bounds_enu_m=np.array([-20.0, -20.0, 0.0, 40.0, 20.0, 50.0]),
        start_enu_m=np.zeros(3),
        goal_enu_m=np.array(goal),
    )


def test_an_empty_world_is_flown_straight() -> None:
    found = check_world(world())
    assert found.path_m == pytest.approx(20.0, abs=0.8)
    assert found.start_clearance_m == np.inf


def test_a_wall_across_the_world_leaves_no_way() -> None:
    assert not check_world(world(WALL)).path_exists


def test_a_low_wall_is_flown_over() -> None:
    low = [*WALL[:5], 2.0]
    assert check_world(world(low)).path_exists
    assert not check_world(world(low), clearance_m=3.5).path_exists


def test_a_gate_is_a_way_for_who_fits_through() -> None:
    gate = [[10, -20, 0, 11, 5, 20], [10, 9, 0, 11, 20, 20]]  # 4 m wide
    assert check_world(world(*gate), clearance_m=1.4).path_exists
    assert not check_world(world(*gate), clearance_m=2.1).path_exists


def test_the_way_round_a_wall_is_as_long_as_the_taut_string() -> None:
    found = check_world(world([10, -20, 0, 11, 8, 20]), clearance_m=2.0)
    # over the corners (10, 8) and (11, 8) with 2 m to spare
    taut = np.hypot(9, 10) + np.hypot(9, 10) + 3.0
    assert found.path_m == pytest.approx(taut, rel=0.06)


def test_the_way_keeps_its_clearance() -> None:
    made = world([10, -20, 0, 11, 8, 20])
    path = check_world(made, clearance_m=2.0).path_enu_m
    points = np.vstack([np.linspace(a, b, 50) for a, b in itertools.pairwise(path)])
    gaps = [distance_to_boxes(made.boxes_enu_m, point).min() for point in points]
    assert min(gaps) >= 2.0 - 0.5  # the grid's cell


def test_start_too_near_a_box_for_the_clearance() -> None:
    found = check_world(world([1, -1, 0, 2, 1, 20]))
    assert found.start_clearance_m == pytest.approx(1.0)
    assert not found.path_exists


def test_a_world_without_end_is_refused_in_one_line() -> None:
    vast = World(
        name="vast", seed=0, boxes_enu_m=np.zeros((0, 6)),
        bounds_enu_m=np.array([-1e200, -1e200, 0.0, 1e200, 1e200, 50.0]),
        start_enu_m=np.zeros(3), goal_enu_m=np.array([20.0, 0.0, 5.0]),
    )  # fmt: skip
    with pytest.raises(WorldError, match="'vast' is too large"):
        check_world(vast)


def test_goal_on_the_edge_of_the_world() -> None:
    assert check_world(world(goal=(40.0, 20.0, 5.0))).path_exists
