"""The whole tree of OctoMap as its own `.ot` file holds it, and what differs between two trees.

After a header, the file has the nodes depth first: the log-odds value (float32) and one byte with a
bit for each child that exists. Source: OctoMap's `OcTreeBaseImpl::writeNodesRecurs`. A leaf is a
node without children. It is occupied if its value is at least 0, which is a probability of 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.autonomy.octree import TREE_DEPTH
from mavfi_cli.core.compiled import compiled

_NODE = np.dtype([("value", "<f4"), ("children", "u1")])


@dataclass(frozen=True, kw_only=True, eq=False)
class Tree:
    """All nodes of a tree, depth first."""

    values: NDArray[np.float32]  # (n,) log-odds
    codes: NDArray[np.int64]  # (n,) Morton code of the first voxel
    depths: NDArray[np.int64]  # (n,) 0 for the root
    leaf: NDArray[np.bool_]  # (n,)

    @property
    def _keys(self) -> NDArray[np.int64]:
        return (self.codes << 5) | self.depths

    def difference(self, other: Tree) -> tuple[int, float]:
        """Number of nodes that differ, and the largest difference of a log-odds value.

        A node differs if only one tree has it, or has it as a leaf, or has another value.
        """
        _, ours, theirs = np.intersect1d(
            self._keys, other._keys, assume_unique=True, return_indices=True
        )
        a, b = self.values[ours], other.values[theirs]
        differs = (a.view(np.int32) != b.view(np.int32)) | (self.leaf[ours] != other.leaf[theirs])
        alone = len(self.values) + len(other.values) - 2 * len(ours)
        with np.errstate(invalid="ignore", over="ignore"):
            gaps = np.abs(a[differs].astype(np.float64) - b[differs])
        return alone + int(differs.sum()), float(gaps[np.isfinite(gaps)].max(initial=0.0))

    def occupied_but_not_in(self, other: Tree) -> int:
        """Number of occupied leaves whose first voxel is free or unknown in the other tree."""
        occupied = self.codes[self.leaf & (self.values >= 0.0)]
        begins = other.codes[other.leaf]
        sizes = np.int64(1) << (3 * (TREE_DEPTH - other.depths[other.leaf]))
        place = np.searchsorted(begins, occupied, side="right") - 1
        place = np.maximum(place, 0)
        inside = (begins[place] <= occupied) & (occupied < begins[place] + sizes[place])
        return int((~(inside & (other.values[other.leaf][place] >= 0.0))).sum())


def read_tree(data: bytes) -> Tree | None:
    """Read a tree from the bytes of an `.ot` file; None if they are no tree."""
    _, found, nodes = data.partition(b"\ndata\n")
    if not found or not nodes or len(nodes) % _NODE.itemsize:
        return None
    table = np.frombuffer(nodes, _NODE)
    children = np.ascontiguousarray(table["children"])
    codes, depths = np.empty(len(table), np.int64), np.empty(len(table), np.int64)
    if _place_nodes(children, codes, depths) != len(table):
        return None
    return Tree(
        values=np.ascontiguousarray(table["value"]),
        codes=codes,
        depths=depths,
        leaf=children == 0,
    )


@compiled
def _place_nodes(
    children: NDArray[np.uint8], codes: NDArray[np.int64], depths: NDArray[np.int64]
) -> int:
    """Fill codes and depths (n,) of nodes in the order of the file.

    Returns the number of nodes of a tree that these make up; 0 if they make up none.
    """
    stack = np.empty((8 * TREE_DEPTH + 8, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, 0
    height, position = 1, 0
    while height > 0:
        if position == children.shape[0]:
            return 0
        height -= 1
        code, depth = stack[height, 0], stack[height, 1]
        codes[position], depths[position] = code, depth
        mask = children[position]
        position += 1
        if mask and depth == TREE_DEPTH:
            return 0
        for child in range(7, -1, -1):
            if (mask >> child) & 1:
                stack[height, 0] = code | (np.int64(child) << (3 * (TREE_DEPTH - depth - 1)))
                stack[height, 1] = depth + 1
                height += 1
    return position
