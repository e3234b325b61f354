"""Greedy shortcutting: removes path vertices that are not needed."""

from __future__ import annotations

import itertools

import numpy as np

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.core.types import FloatArray


def shortcut(path_enu_m: FloatArray, grid: ObstacleGrid) -> FloatArray:
    """Connect each vertex of a path (n, 3) to the farthest later vertex in line of sight.

    The result has the same start and end and is never longer. It is free if the path was free. The
    greedy rule is that of the released planner (MAVBench/MAV_apps, branch mavfi).
    """
    kept = [0]
    last = len(path_enu_m) - 1
    while kept[-1] < last:
        here = kept[-1]
        there = last
        while there > here + 1 and not grid.segment_free(path_enu_m[here], path_enu_m[there]):
            there -= 1
        kept.append(there)
    return np.ascontiguousarray(path_enu_m[kept])


def subdivided(path_enu_m: FloatArray, spacing_m: float) -> FloatArray:
    """Subdivide a path into vertices (m, 3) at most `spacing_m` apart."""
    pieces = [path_enu_m[:1]]
    for start, end in itertools.pairwise(path_enu_m):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / spacing_m)))
        shares = np.arange(1, count + 1)[:, None] / count
        pieces.append(start + shares * (end - start))
    return np.vstack(pieces)
