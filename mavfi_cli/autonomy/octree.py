"""Decoder of OctoMap's binary node stream.

Nodes are stored depth first with two bytes per node and two bits per child. The low bit means
"free or inner", the high bit "occupied or inner". Inner children follow in order. Bits 0, 1, 2 of
child number c select the upper half along x, y, z. The root covers 2^16 voxels per side and is
centred on the world's origin. Source: OctoMap's `AbstractOccupancyOcTree`.

Voxel (i, j, k) spans [i, i + 1) x [j, j + 1) x [k, k + 1) in units of the resolution.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled

TREE_DEPTH = 16
HALF_RANGE = 1 << (TREE_DEPTH - 1)


def occupied_leaves(stream: bytes) -> NDArray[np.int64]:
    """Return the occupied cubes of a node stream, (n, 4): the lower corner x y z, and the size.

    The unit is one voxel. A truncated or invalid stream gives the cubes up to the error.
    """
    # A two-byte node has at most eight leaves.
    leaves = np.empty((4 * len(stream), 4), np.int64)
    count = decode_leaves(np.frombuffer(stream, np.uint8), leaves)
    return leaves[:count].copy()


@compiled
def decode_leaves(stream: NDArray[np.uint8], leaves: NDArray[np.int64]) -> int:
    """Write the occupied cubes of a node stream to `leaves`, and return how many there are."""
    stack = np.empty((8 * TREE_DEPTH + 8, 4), np.int64)  # x y z of the lower corner, size
    stack[0, 0], stack[0, 1], stack[0, 2] = -HALF_RANGE, -HALF_RANGE, -HALF_RANGE
    stack[0, 3] = 2 * HALF_RANGE
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
        for child in range(7, -1, -1):  # reversed, as the stack returns its last entry first
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
                leaves[count, 3] = half
                count += 1
    return count
