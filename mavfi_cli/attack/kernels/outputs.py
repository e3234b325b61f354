"""Outputs of kernels: how they are packed, and how the size of a difference is found.

Every comparison has a tolerance of its own, beside equality of all bits: a difference beyond it is
*noticeable* to whatever takes the output.
"""

from __future__ import annotations

import io
import math
import tokenize
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.attack.comparison import Difference
from mavfi_cli.attack.kernels.tree import read_tree
from mavfi_cli.autonomy.octree import occupied_leaves

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
    ours, theirs = read_tree(golden["tree"].tobytes()), read_tree(output["tree"].tobytes())
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
