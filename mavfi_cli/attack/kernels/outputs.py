"""Outputs of kernels: how they are packed, and how the size of a difference is found.

Every comparison has a tolerance of its own, beside equality of all bits: a difference beyond it is
*noticeable* to whatever takes the output.
"""

from __future__ import annotations

import io
import math
import tokenize
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.attack.comparison import Difference
from mavfi_cli.autonomy.octree import TREE_DEPTH, occupied_leaves
from mavfi_cli.core.compiled import compiled

Array = NDArray[np.generic]
# A function takes effort that is no part of the kernel: it is called when the kernel has ended.
Output = dict[str, Array | Callable[[], Array]]
Numbers = dict[str, Array]

SMALL = 1e-6  # relative difference of numbers that nobody notices
HALF_A_VOXEL_M = 0.1  # finer than the map; also of a path
A_TICK_S = 0.1  # of a foreseen collision

# Errors that numpy raises for an array with a broken header, beside ValueError.
_DAMAGE = (
    OSError, EOFError, SyntaxError, MemoryError, TypeError, OverflowError, SystemError,
    tokenize.TokenError,
)  # fmt: skip


def pack(output: Output) -> bytes:
    """Pack the arrays in the order of the dictionary; equal outputs give equal bytes."""
    buffer = io.BytesIO()
    for name, array in output.items():
        np.save(buffer, np.array(name))
        np.save(buffer, array() if callable(array) else array, allow_pickle=False)
    return buffer.getvalue()


def unpack(data: bytes) -> Numbers:
    """Read what `pack` wrote.

    Raises:
        ValueError: the bytes are something else.
    """
    buffer, output = io.BytesIO(data), {}
    try:
        while buffer.tell() < len(data):
            name = np.load(buffer, allow_pickle=False)
            output[str(name)] = np.load(buffer, allow_pickle=False)
    except _DAMAGE as error:
        raise ValueError(f"damaged output: {error}") from None
    return output


def numbers(golden: Numbers, output: Numbers) -> Difference:
    """Largest difference of a number, relative to the golden one, or absolute if that is 0.

    It is noticeable if it is larger than `SMALL`.
    """
    changed, largest, relative = 0, 0.0, 0.0
    for name, expected in golden.items():
        got = output.get(name)
        if got is None or got.shape != expected.shape:
            shape = "missing" if got is None else f"{got.shape} instead of {expected.shape}"
            return _incomparable(f"{name}: {shape}")
        differs = ~((got == expected) | (_nan(got) & _nan(expected)))
        if not differs.any():
            continue
        changed += int(differs.sum())
        a = expected[differs].astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            gaps = np.abs(got[differs].astype(np.float64) - a)
            shares = gaps / np.where(a == 0.0, 1.0, np.abs(a))
        if not np.isfinite(gaps).all():
            return _incomparable(f"{name}: not a number")
        largest, relative = max(largest, float(gaps.max())), max(relative, float(shares.max()))
    text = f"{changed} of {sum(array.size for array in golden.values())} numbers"
    noticeable = relative > SMALL
    return Difference(relative=relative, absolute=largest, text=text, noticeable=noticeable)


def _nan(array: NDArray[np.generic]) -> NDArray[np.bool_]:
    if not np.issubdtype(array.dtype, np.floating):
        return np.zeros(array.shape, np.bool_)
    return np.isnan(array.astype(np.float64))


def maps(golden: Numbers, output: Numbers) -> Difference:
    """Number of nodes of the tree that are there only once or have another log-odds value.

    It is noticeable if another voxel is occupied, in the tree or in the planner's map.
    """
    ours, theirs = _read_tree(golden["tree"].tobytes()), _read_tree(output["tree"].tobytes())
    if theirs is None or ours is None:
        return _incomparable("the tree cannot be read")
    nodes, log_odds = ours.difference(theirs)
    seen, also = _occupied(golden), _occupied(output)
    occupied = {
        "false_free": ours.occupied_but_not_in(theirs),
        "false_occupied": theirs.occupied_but_not_in(ours),
        "missing_for_planner": len(seen - also),
        "added_for_planner": len(also - seen),
    }
    voxels = sum(occupied.values())
    text = ", ".join(f"{name} {count}" for name, count in occupied.items() if count)
    return Difference(
        relative=nodes / len(ours.values) or float(voxels > 0),
        absolute=float(nodes or voxels),
        unit="nodes" if nodes else "voxels",
        text=f"{nodes} nodes; voxels: {text or 'none'}",
        noticeable=voxels > 0,
        parts={"nodes": nodes, "log_odds": log_odds, **occupied},
    )


def _occupied(output: Numbers) -> set[tuple[int, int, int]]:
    found: set[tuple[int, int, int]] = set()
    for x, y, z, size in occupied_leaves(output["payload"].tobytes()).tolist():
        if size > 64:  # a corrupted stream: one huge cube stands for itself
            found.add((x, y, z))
            continue
        found.update(
            (x + i, y + j, z + k) for i in range(size) for j in range(size) for k in range(size)
        )
    return found


def checks(golden: Numbers, output: Numbers) -> Difference:
    """Difference of the foreseen collisions, pose by pose.

    A collision that is missed or made up is noticeable, and a gap in time above `A_TICK_S`.
    """
    found = numbers(golden, output)
    times, others = golden["time_to_collision_s"], output.get("time_to_collision_s")
    if others is None or others.shape != times.shape:
        return found
    ours, theirs = times.astype(np.float64), others.astype(np.float64)
    hit, also = np.isfinite(ours), np.isfinite(theirs)
    gaps = np.abs(ours[hit & also] - theirs[hit & also])
    parts = {
        "missed": int((hit & ~also).sum()),
        "false_alarms": int((also & ~hit).sum()),
        "gap_s": float(gaps.max(initial=0.0)),
    }
    return replace(
        found,
        text=f"{parts['missed']} of {int(hit.sum())} collisions missed, {parts['false_alarms']} "
        f"made up, {parts['gap_s']:.3g} s; {found.text}",
        noticeable=bool((hit != also).any() or parts["gap_s"] > A_TICK_S),
        parts=parts,
    )


def paths(golden: Numbers, output: Numbers) -> Difference:
    """Difference of a planned path in length, and how far apart the two paths are, m.

    It is noticeable if either is above `HALF_A_VOXEL_M`.
    """
    path, another = golden["path_enu_m"], output["path_enu_m"]
    ours, theirs = path.astype(np.float64), another.astype(np.float64)
    if bool(golden["found"]) != bool(output["found"]):
        return _incomparable("a path" if output["found"] else "no path")
    if not len(ours) or not len(theirs) or not np.isfinite(theirs).all():
        return _incomparable("another failure" if not len(theirs) else "not a number")
    length, other = _length(ours), _length(theirs)
    apart = max(_farthest(ours, theirs), _farthest(theirs, ours))
    gap = max(abs(other - length), apart)
    return Difference(
        relative=gap / (length or 1.0),
        absolute=gap,
        unit="m",
        text=f"{other - length:+.3f} m long, {apart:.3f} m apart, {len(theirs)} vertices",
        noticeable=gap > HALF_A_VOXEL_M,
        parts={"longer_m": other - length, "apart_m": apart},
    )


def _length(path: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _farthest(path: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """The largest distance of a vertex of one path (n, 3) from the other (m, 3)."""
    begins, steps = other[:-1], np.diff(other, axis=0)
    if not len(steps):
        begins, steps = other, np.zeros_like(other)
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.maximum((steps**2).sum(axis=1), np.finfo(np.float64).tiny)
        along = ((path[:, None] - begins) * steps).sum(axis=2) / squares
        nearest = begins + np.clip(along, 0.0, 1.0)[..., None] * steps
        gaps = np.linalg.norm(path[:, None] - nearest, axis=2).min(axis=1)
    return float(gaps.max())


def _incomparable(text: str) -> Difference:
    return Difference(relative=math.inf, absolute=math.inf, text=text)


# -- the tree of OctoMap

# Its `.ot` file holds the nodes depth first, after a header: the log-odds value and one byte with a
# bit for each child that exists (OctoMap's `OcTreeBaseImpl::writeNodesRecurs`). A leaf is a node
# without children. It is occupied if its value is at least 0, which is a probability of 0.5.
_NODE = np.dtype([("value", "<f4"), ("children", "u1")])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tree:
    """All nodes of a tree, depth first."""

    values: NDArray[np.float32]  # (n,) log-odds
    codes: NDArray[np.int64]  # (n,) Morton code of the first voxel
    depths: NDArray[np.int64]  # (n,) 0 for the root
    leaf: NDArray[np.bool_]  # (n,)

    @property
    def _keys(self) -> NDArray[np.int64]:
        return (self.codes << 5) | self.depths

    def difference(self, other: _Tree) -> tuple[int, float]:
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

    def occupied_but_not_in(self, other: _Tree) -> int:
        """Number of occupied leaves whose first voxel is free or unknown in the other tree."""
        occupied = self.codes[self.leaf & (self.values >= 0.0)]
        begins = other.codes[other.leaf]
        sizes = np.int64(1) << (3 * (TREE_DEPTH - other.depths[other.leaf]))
        place = np.searchsorted(begins, occupied, side="right") - 1
        place = np.maximum(place, 0)
        inside = (begins[place] <= occupied) & (occupied < begins[place] + sizes[place])
        return int((~(inside & (other.values[other.leaf][place] >= 0.0))).sum())


def _read_tree(data: bytes) -> _Tree | None:
    """Read a tree from the bytes of an `.ot` file; None if they are no tree."""
    _, found, nodes = data.partition(b"\ndata\n")
    if not found or not nodes or len(nodes) % _NODE.itemsize:
        return None
    table = np.frombuffer(nodes, _NODE)
    children = np.ascontiguousarray(table["children"])
    codes, depths = np.empty(len(table), np.int64), np.empty(len(table), np.int64)
    if _place_nodes(children, codes, depths) != len(table):
        return None
    return _Tree(
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
