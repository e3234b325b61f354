"""The obstacle grid: exact distances for the dilation, dense sampling for the segment test."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot

BOUNDS = np.array([-10.0, -10.0, 0.0, 10.0, 10.0, 10.0])
RADIUS_M = 0.7
RESOLUTION_M = 0.2


def scattered(count=40, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform([-9, -9, 1], [9, 9, 9], (count, 3))


def gap_to_voxels(point, points):
    """Exact distance from a point to the voxels that hold `points`."""
    low = np.floor(points / RESOLUTION_M) * RESOLUTION_M
    outside = np.maximum(0.0, np.maximum(low - point, point - low - RESOLUTION_M))
    return np.linalg.norm(outside, axis=1).min()


def test_free_points_keep_the_radius_and_blocked_ones_are_near():
    points = scattered()
    grid = ObstacleGrid.build(MapSnapshot.of_points(points), BOUNDS, RADIUS_M)
    rng = np.random.default_rng(1)
    diagonal = RESOLUTION_M * math.sqrt(3)
    verdicts = set()
    for probe in rng.uniform([-9.5, -9.5, 0.5], [9.5, 9.5, 9.5], (3000, 3)):
        gap = gap_to_voxels(probe, points)
        free = grid.point_free(probe)
        verdicts.add(free)
        assert (gap >= RADIUS_M) if free else (gap < RADIUS_M + diagonal)
    assert verdicts == {True, False}


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_a_segment_is_free_exactly_where_all_its_points_are(seed):
    grid = ObstacleGrid.build(MapSnapshot.of_points(scattered()), BOUNDS, RADIUS_M)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        start, end = rng.uniform([-9.9, -9.9, 0.1], [9.9, 9.9, 9.9], (2, 3))
        shares = np.linspace(0.0, 1.0, 4000)[:, None]
        sampled = start + shares * (end - start)
        index = np.floor((sampled - grid.origin_enu_m) / RESOLUTION_M).astype(int)
        inside = ((index >= 0) & (index < grid.blocked.shape)).all(axis=1)
        hits = grid.blocked[tuple(index[inside].T)].sum()
        if grid.segment_free(start, end):
            assert hits == 0
        elif hits == 0:
            # The traversal may cut a corner that 4,000 samples step over.
            finer = start + np.linspace(0.0, 1.0, 2_000_000)[:, None] * (end - start)
            index = np.floor((finer - grid.origin_enu_m) / RESOLUTION_M).astype(int)
            inside = ((index >= 0) & (index < grid.blocked.shape)).all(axis=1)
            assert grid.blocked[tuple(index[inside].T)].any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
def test_ends_that_are_not_in_the_bounds_are_not_free(bad):
    grid = ObstacleGrid.build(MapSnapshot.of_points(scattered()), BOUNDS, RADIUS_M)
    here = np.array([0.0, 0.0, 5.0])
    for axis in range(3):
        there = here.copy()
        there[axis] = bad
        assert not grid.segment_free(here, there)
        assert not grid.segment_free(there, here)


def test_without_obstacles_only_the_bounds_matter():
    grid = ObstacleGrid.build(MapSnapshot.empty(), BOUNDS, RADIUS_M)
    assert grid.segment_free(np.array([-10.0, -10, 0]), np.array([10.0, 10, 10]))
    assert not grid.point_free(np.array([0.0, 0.0, 10.1]))


def test_obstacles_just_outside_the_bounds_reach_in():
    grid = ObstacleGrid.build(MapSnapshot.of_points(np.array([[10.3, 0.1, 5.1]])), BOUNDS, RADIUS_M)
    assert not grid.point_free(np.array([9.9, 0.1, 5.1]))
    assert grid.point_free(np.array([9.0, 0.1, 5.1]))


def test_a_path_is_free_where_all_its_pieces_are():
    grid = ObstacleGrid.build(MapSnapshot.of_points(np.array([[0.1, 0.1, 5.1]])), BOUNDS, RADIUS_M)
    around = np.array([[-5.0, 0, 5], [0, 5, 5], [5, 0, 5]])
    through = np.array([[-5.0, 0, 5], [5, 0, 5], [5, 5, 5]])
    assert grid.path_free(around)
    assert not grid.path_free(through)


def test_blending_takes_the_inner_grid_near_the_centre_only():
    points = np.array([[0.1, 0.1, 5.1], [5.1, 0.1, 5.1]])
    wide = ObstacleGrid.build(MapSnapshot.of_points(points), BOUNDS, 1.0)
    slim = ObstacleGrid.build(MapSnapshot.of_points(points), BOUNDS, 0.3)
    blocked = wide.blended(slim, np.array([0.0, 0.0, 5.0]), 2.0).blocked
    offset = np.rint((wide.origin_enu_m - slim.origin_enu_m) / RESOLUTION_M).astype(int)
    for index in np.ndindex(*blocked.shape):
        centre = wide.origin_enu_m + (np.array(index) + 0.5) * RESOLUTION_M
        if np.linalg.norm(centre - [0, 0, 5]) < 1.99:
            there = index + offset
            inside = (there >= 0).all() and (there < slim.blocked.shape).all()
            assert blocked[index] == (slim.blocked[tuple(there)] if inside else 0)
        elif np.linalg.norm(centre - [0, 0, 5]) > 2.01:
            assert blocked[index] == wide.blocked[index]


def test_a_grid_that_would_not_fit_into_memory_is_refused():
    huge = np.array([-1e4, -1e4, -1e3, 1e4, 1e4, 1e3])
    far_apart = np.array([[-6000.0, -6000, 0], [6000, 6000, 10]])
    with pytest.raises(ValueError, match="at most 60000000 voxels"):
        ObstacleGrid.build(MapSnapshot.of_points(far_apart), huge, RADIUS_M)
