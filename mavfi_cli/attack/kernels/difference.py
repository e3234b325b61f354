"""Difference between a kernel's output and the golden one, in terms of what it computes."""

from __future__ import annotations

import io
import math
import tokenize
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.attack.target import Difference
from mavfi_cli.autonomy.octree import occupied_leaves

Output = dict[str, NDArray[np.generic]]

# Errors that numpy raises for an array with a broken header, beside ValueError.
_DAMAGE = (
    OSError, EOFError, SyntaxError, MemoryError, TypeError, OverflowError, SystemError,
    tokenize.TokenError,
)  # fmt: skip


Compare = Callable[[Output, Output], Difference]


def pack(output: Output) -> bytes:
    """Pack the arrays in the order of the dictionary; equal outputs give equal bytes."""
    buffer = io.BytesIO()
    for name, array in output.items():
        np.save(buffer, np.array(name))
        np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def unpack(data: bytes) -> Output:
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


def numbers(golden: Output, output: Output) -> Difference:
    """Largest difference of a number, relative to the golden one, or absolute if that is 0."""
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
    return Difference(relative=relative, absolute=largest, text=text)


def _nan(array: NDArray[np.generic]) -> NDArray[np.bool_]:
    if not np.issubdtype(array.dtype, np.floating):
        return np.zeros(array.shape, np.bool_)
    return np.isnan(array.astype(np.float64))


def voxels(golden: Output, output: Output) -> Difference:
    """Number of voxels occupied in only one map, relative to those of the golden map.

    If the same voxels are occupied, the difference is in the number of the tree's nodes.
    """
    ours, theirs = _occupied(golden), _occupied(output)
    count = len(ours ^ theirs)
    if not count:
        nodes, other = int(golden["nodes"]), int(output["nodes"])
        gap = abs(other - nodes)
        text = f"{other - nodes:+d} nodes"
        return Difference(relative=gap / nodes, absolute=float(gap), unit="nodes", text=text)
    text = f"{len(ours - theirs)} voxels missing, {len(theirs - ours)} added"
    return Difference(
        relative=count / max(1, len(ours)), absolute=float(count), unit="voxels", text=text
    )


def _occupied(output: Output) -> set[tuple[int, int, int]]:
    found: set[tuple[int, int, int]] = set()
    for x, y, z, size in occupied_leaves(output["payload"].tobytes()).tolist():
        if size > 64:  # a corrupted stream: one huge cube stands for itself
            found.add((x, y, z))
            continue
        found.update(
            (x + i, y + j, z + k) for i in range(size) for j in range(size) for k in range(size)
        )
    return found


def paths(golden: Output, output: Output) -> Difference:
    """Difference of a planned path in length and in the position of its ends, m."""
    ours, theirs = golden["path_enu_m"], output["path_enu_m"]
    if bool(golden["found"]) != bool(output["found"]):
        return _incomparable("a path" if output["found"] else "no path")
    if not len(ours) or not len(theirs) or not np.isfinite(theirs.astype(np.float64)).all():
        return _incomparable("another failure" if not len(theirs) else "not a number")
    length, other = _length(ours), _length(theirs)
    ends = max(
        math.dist(ours[0].tolist(), theirs[0].tolist()),
        math.dist(ours[-1].tolist(), theirs[-1].tolist()),
    )
    gap = abs(other - length)
    text = f"{other - length:+.3f} m long, ends {ends:.3f} m off, {len(theirs)} vertices"
    return Difference(
        relative=max(gap, ends) / (length or 1.0), absolute=max(gap, ends), unit="m", text=text
    )


def _length(path: NDArray[np.generic]) -> float:
    steps = np.diff(path.astype(np.float64), axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def _incomparable(text: str) -> Difference:
    return Difference(relative=math.inf, absolute=math.inf, text=text)
