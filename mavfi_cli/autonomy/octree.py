"""Reading the octree of a map snapshot: which voxels are occupied.

OctoMap's binary node stream: depth first, two bytes a node, two bits a child, of which the low
one says "free or inner" and the high one "occupied or inner"; inner children follow in order.
Child c lies in the upper half along x, y, z for bits 0, 1, 2 of c. The root covers 2^16 voxels a
side, centred on the world's origin. Source: the format as `AbstractOccupancyOcTree` writes it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.autonomy.compiled import compiled
from mavfi_cli.autonomy.occupancy import MapSnapshot

TREE_DEPTH = 16


def occupied_leaves(snapshot: MapSnapshot) -> NDArray[np.int64]:
    """Occupied cubes as voxel indices (n, 6): x y z of the lower corner, then size three times.

    Voxel (i, j, k) spans [i, i + 1) x [j, j + 1) x [k, k + 1) in units of the resolution. A
    stream that is cut short or senseless gives the leaves up to that point.
    """
    stream = np.frombuffer(snapshot.payload, np.uint8)
    # A node of two bytes has at most eight leaves.
    leaves = np.empty((4 * len(stream), 6), np.int64)
    count = _decode(stream, leaves)
    return leaves[:count].copy()


@compiled
def _decode(stream: NDArray[np.uint8], leaves: NDArray[np.int64]) -> int:
    """Fill `leaves` from the node stream; returns how many."""
    stack = np.empty((8 * TREE_DEPTH + 8, 4), np.int64)  # x y z of the lower corner, size
    half_range = 1 << (TREE_DEPTH - 1)
    stack[0, 0], stack[0, 1], stack[0, 2] = -half_range, -half_range, -half_range
    stack[0, 3] = 2 * half_range
    depth = 1
    count = 0
    position = 0
    while depth > 0 and position + 1 < len(stream):
        depth -= 1
        x, y, z, size = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3]
        half = size // 2
        if half == 0:
            break
        children = int(stream[position]) | (int(stream[position + 1]) << 8)
        position += 2
        for child in range(7, -1, -1):  # last first: the stack gives the first back first
            kind = (children >> (2 * child)) & 3
            cx = x + half * (child & 1)
            cy = y + half * ((child >> 1) & 1)
            cz = z + half * ((child >> 2) & 1)
            if kind == 3:
                stack[depth, 0], stack[depth, 1], stack[depth, 2] = cx, cy, cz
                stack[depth, 3] = half
                depth += 1
            elif kind == 2:
                leaves[count, 0], leaves[count, 1], leaves[count, 2] = cx, cy, cz
                leaves[count, 3:] = half
                count += 1
    return count
