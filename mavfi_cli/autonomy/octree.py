"""Encoder and decoder of OctoMap's binary node stream.

Nodes are stored depth first with two bytes per node and two bits per child. The low bit means
"free or inner", the high bit "occupied or inner". Inner children follow in order. Bits 0, 1, 2 of
child number c select the upper half along x, y, z. The root covers 2^16 voxels per side and is
centred on the world's origin. Source: OctoMap's `AbstractOccupancyOcTree`.

A voxel's Morton code interleaves the bits of its indices (x lowest), so sorted codes are in the
stream's order. Voxel (i, j, k) spans [i, i + 1) x [j, j + 1) x [k, k + 1) in units of the
resolution.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray

TREE_DEPTH = 16
HALF_RANGE = 1 << (TREE_DEPTH - 1)

Codes = NDArray[np.int64]


@compiled
def morton_codes(points: FloatArray, resolution: float, codes: Codes) -> int:
    """Write the codes of the voxels of points (n, 3) and return their number.

    Points that are not finite or outside the octree's range have no code. Coordinates are rounded
    to single precision first, as in OctoMap.
    """
    count = 0
    factor = 1.0 / resolution
    for i in range(points.shape[0]):
        code = 0
        for axis in range(3):
            scaled = math.floor(factor * np.float64(np.float32(points[i, axis]))) + HALF_RANGE
            if not 0 <= scaled < 2 * HALF_RANGE:
                code = -1
                break
            index = int(scaled)
            for bit in range(TREE_DEPTH):
                code |= ((index >> bit) & 1) << (3 * bit + axis)
        if code >= 0:
            codes[count] = code
            count += 1
    return count


@compiled
def voxel_centres(codes: Codes, resolution: float, centres: FloatArray) -> None:
    """Write the centres (n, 3), m, of the voxels with the given codes (n,)."""
    for i in range(codes.shape[0]):
        for axis in range(3):
            index = 0
            for bit in range(TREE_DEPTH):
                index |= ((codes[i] >> (3 * bit + axis)) & 1) << bit
            centres[i, axis] = (index - HALF_RANGE + 0.5) * resolution


def encode(codes: Codes) -> bytes:
    """Encode a tree in which exactly these voxels are occupied and all others unknown.

    `codes` (n,) must be sorted and distinct. A fully occupied cube becomes one leaf.
    """
    if not len(codes):
        return b""
    stream = np.empty(2 * TREE_DEPTH * len(codes), np.uint8)
    return stream[: _encode(codes, stream)].tobytes()


@compiled
def _encode(codes: Codes, stream: NDArray[np.uint8]) -> int:
    """Fill `stream` and return the number of bytes."""
    stack = np.empty((8 * TREE_DEPTH + 8, 3), np.int64)  # first code, end of codes, height
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, len(codes), TREE_DEPTH
    depth, position = 1, 0
    ends = np.empty(8, np.int64)
    while depth > 0:
        depth -= 1
        first, end, height = stack[depth, 0], stack[depth, 1], stack[depth, 2] - 1
        shift = 3 * height
        full = 1 << shift
        begin, children = first, 0
        for child in range(8):
            last = begin
            if height == 0:
                while last < end and (codes[last] & 7) == child:
                    last += 1
            else:
                bound = (((codes[first] >> (shift + 3)) << 3) + child + 1) << shift
                last = begin + np.searchsorted(codes[begin:end], bound)
            ends[child] = last
            if last > begin:
                kind = 2 if last - begin == full else 3
                children |= kind << (2 * child)
            begin = last
        stream[position], stream[position + 1] = children & 255, children >> 8
        position += 2
        for child in range(7, -1, -1):  # last first: the stack gives the first back first
            if (children >> (2 * child)) & 3 == 3:
                stack[depth, 0] = ends[child - 1] if child > 0 else first
                stack[depth, 1], stack[depth, 2] = ends[child], height
                depth += 1
    return position


def occupied_leaves(stream: bytes) -> NDArray[np.int64]:
    """Decode the occupied cubes of a node stream as voxel indices (n, 4): lower corner x y z, size.

    A truncated or invalid stream gives the leaves up to the error.
    """
    # A two-byte node has at most eight leaves.
    leaves = np.empty((4 * len(stream), 4), np.int64)
    count = decode_leaves(np.frombuffer(stream, np.uint8), leaves)
    return leaves[:count].copy()


@compiled
def decode_leaves(stream: NDArray[np.uint8], leaves: NDArray[np.int64]) -> int:
    """Fill `leaves` from the node stream and return their number."""
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
                leaves[count, 3] = half
                count += 1
    return count
