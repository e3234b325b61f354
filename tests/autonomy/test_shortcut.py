"""Shortcutting keeps the ends, never lengthens, and never leaves free space."""

import numpy as np

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.planning import shortcut, subdivided

BOUNDS = np.array([-10.0, -10.0, 0.0, 10.0, 10.0, 10.0])


def length(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum()


def test_random_walks_become_shorter_and_stay_free():
    rng = np.random.default_rng(0)
    grid = ObstacleGrid.build(
        MapSnapshot.of_points(rng.uniform([-9, -9, 3], [9, 9, 7], (30, 3))), BOUNDS, 0.5
    )
    for _ in range(40):
        path = [np.array([-9.5, -9.5, 5.0])]
        while len(path) < 12:
            candidate = np.clip(path[-1] + rng.normal(size=3) * 2, BOUNDS[:3], BOUNDS[3:])
            if grid.segment_free(path[-1], candidate):
                path.append(candidate)
        path = np.array(path)
        short = shortcut(path, grid)
        assert grid.path_free(short)
        assert length(short) <= length(path) + 1e-9
        assert len(short) <= len(path)
        np.testing.assert_array_equal(short[[0, -1]], path[[0, -1]])


def test_in_free_sight_only_the_ends_remain():
    grid = ObstacleGrid.build(MapSnapshot.of_points(np.empty((0, 3))), BOUNDS, 0.5)
    zigzag = np.array([[0.0, 0, 5], [1, 1, 5], [2, -1, 5], [3, 0, 5]])
    assert shortcut(zigzag, grid).tolist() == [[0, 0, 5], [3, 0, 5]]


def test_subdividing_keeps_the_path():
    path = np.array([[0.0, 0, 5], [3, 0, 5], [3, 0.5, 5]])
    fine = subdivided(path, 1.0)
    assert fine.tolist() == [[0, 0, 5], [1, 0, 5], [2, 0, 5], [3, 0, 5], [3, 0.5, 5]]
