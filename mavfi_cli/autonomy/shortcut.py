"""Greedy shortcutting: leave out every vertex that is not needed."""

from __future__ import annotations

import itertools

import numpy as np

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.core.types import FloatArray


def shortcut(path_enu_m: FloatArray, grid: ObstacleGrid) -> FloatArray:
    """The path (n, 3) with each vertex joined to the farthest later one in free sight.

    Starts and ends where it did; never longer than it was; free if it was free. The greedy rule
    is the reference's (facts, section 4.5).
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
    """The same path with vertices at most `spacing_m` apart, (m, 3)."""
    pieces = [path_enu_m[:1]]
    for start, end in itertools.pairwise(path_enu_m):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / spacing_m)))
        shares = np.arange(1, count + 1)[:, None] / count
        pieces.append(start + shares * (end - start))
    return np.vstack(pieces)
