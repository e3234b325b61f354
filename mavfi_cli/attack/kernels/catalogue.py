"""The kernels that can be attacked in isolation: how to call them and compare their outputs."""

from __future__ import annotations

import functools
import importlib.util
import io
import math
import sys
import tokenize
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.attack.comparison import Difference
from mavfi_cli.attack.kernels.inputs import KernelInputs
from mavfi_cli.autonomy import collision, occupancy, planners, point_cloud, tracking
from mavfi_cli.autonomy.grid import segment_free
from mavfi_cli.autonomy.octree import TREE_DEPTH, occupied_leaves
from mavfi_cli.autonomy.planners import PlanningParams, PlanningProblem
from mavfi_cli.autonomy.tracking import waypoint_index
from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.errors import TargetError, UnknownName

if TYPE_CHECKING:
    from mavfi_cli.attack.kernels.scope import KernelScope

Array = NDArray[np.generic]
# A callable does work that is not part of the kernel. It is called after the kernel has ended.
Output = dict[str, Array | Callable[[], Array]]
Numbers = dict[str, Array]

Call = Callable[[], Output]
_FILLED_MB_PER_S = 512  # minimum rate of a loop that allocates
_POSES = 5  # number of poses from which the collision check looks ahead
_SMALL = 1e-6  # largest unnoticeable relative difference of numbers
_HALF_A_VOXEL_M = 0.1  # largest unnoticeable difference of a path; finer than the map
_A_TICK_S = 0.1  # largest unnoticeable shift of a foreseen collision

# Errors that numpy raises for an array with a broken header, besides ValueError.
_DAMAGE = (
    OSError, EOFError, SyntaxError, MemoryError, TypeError, OverflowError, SystemError,
    tokenize.TokenError,
)  # fmt: skip


def pack(output: Output) -> bytes:
    """Pack the arrays of an output, in the dictionary's order. Equal outputs give equal bytes."""
    buffer = io.BytesIO()
    for name, array in output.items():
        np.save(buffer, np.array(name))
        np.save(buffer, array() if callable(array) else array, allow_pickle=False)
    return buffer.getvalue()


def unpack(data: bytes) -> Numbers:
    """Unpack the arrays that `pack` has packed, keyed by name.

    Raises:
        ValueError: the bytes are not a packed output.
    """
    buffer, output = io.BytesIO(data), {}
    try:
        while buffer.tell() < len(data):
            name = np.load(buffer, allow_pickle=False)
            output[str(name)] = np.load(buffer, allow_pickle=False)
    except _DAMAGE as error:
        raise ValueError(f"damaged output: {error}") from None
    return output


def _numbers(golden: Numbers, output: Numbers) -> Difference:
    """Return the largest difference between corresponding numbers of two outputs.

    Differences are relative to the golden number, or to 1 if that is 0; they are noticeable above
    `_SMALL`.
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
    noticeable = relative > _SMALL
    return Difference(relative=relative, absolute=largest, text=text, noticeable=noticeable)


def _nan(array: NDArray[np.generic]) -> NDArray[np.bool_]:
    if not np.issubdtype(array.dtype, np.floating):
        return np.zeros(array.shape, np.bool_)
    return np.isnan(array.astype(np.float64))


def _maps(golden: Numbers, output: Numbers) -> Difference:
    """Compare the OctoMap trees of two outputs by their nodes and occupied voxels.

    The absolute difference is the number of nodes that `_Tree.difference` counts, and the relative
    one is their number divided by that of the golden tree's nodes. If no node differs, the absolute
    difference is the number of voxels. The difference is noticeable if the sets of occupied voxels
    differ, in the tree or in the planner's map.
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
    occupied: set[tuple[int, int, int]] = set()
    for x, y, z, size in occupied_leaves(output["payload"].tobytes()).tolist():
        if size > 64:  # a corrupted stream: a huge cube counts as one voxel
            occupied.add((x, y, z))
            continue
        occupied.update(
            (x + i, y + j, z + k) for i in range(size) for j in range(size) for k in range(size)
        )
    return occupied


def _checks(golden: Numbers, output: Numbers) -> Difference:
    """Compare the collisions that two outputs predict, pose by pose.

    A missed or spurious collision is noticeable, and so is a shift in time above `_A_TICK_S`.
    """
    difference = _numbers(golden, output)
    times, others = golden["time_to_collision_s"], output.get("time_to_collision_s")
    if others is None or others.shape != times.shape:
        return difference
    ours, theirs = times.astype(np.float64), others.astype(np.float64)
    hit, also = np.isfinite(ours), np.isfinite(theirs)
    gaps = np.abs(ours[hit & also] - theirs[hit & also])
    parts = {
        "missed": int((hit & ~also).sum()),
        "false_alarms": int((also & ~hit).sum()),
        "gap_s": float(gaps.max(initial=0.0)),
    }
    return replace(
        difference,
        text=f"{parts['missed']} of {int(hit.sum())} collisions missed, {parts['false_alarms']} "
        f"made up, {parts['gap_s']:.3g} s; {difference.text}",
        noticeable=bool((hit != also).any() or parts["gap_s"] > _A_TICK_S),
        parts=parts,
    )


def _paths(golden: Numbers, output: Numbers) -> Difference:
    """Compare two planned paths by their lengths and the largest distance between them, in metres.

    The difference is noticeable if the lengths differ by more than `_HALF_A_VOXEL_M`, or if the
    largest distance is above it.
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
        noticeable=gap > _HALF_A_VOXEL_M,
        parts={"longer_m": other - length, "apart_m": apart},
    )


def _length(path: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _farthest(path: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the largest distance from a vertex of `path` to the path `other`.

    The paths are arrays of vertices, of shapes (n, 3) and (m, 3).
    """
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
    """All nodes of an OctoMap tree, in depth-first order."""

    values: NDArray[np.float32]  # (n,) log-odds
    codes: NDArray[np.int64]  # (n,) Morton code of the first voxel
    depths: NDArray[np.int64]  # (n,) 0 for the root
    leaf: NDArray[np.bool_]  # (n,)

    @property
    def _keys(self) -> NDArray[np.int64]:
        return (self.codes << 5) | self.depths

    def difference(self, other: _Tree) -> tuple[int, float]:
        """Return the number of differing nodes and the largest difference of log-odds.

        A node differs if only one tree contains it or has it as a leaf, or if its values differ.
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
        """Count occupied leaves whose first voxel is free or unknown in the other tree."""
        occupied = self.codes[self.leaf & (self.values >= 0.0)]
        begins = other.codes[other.leaf]
        sizes = np.int64(1) << (3 * (TREE_DEPTH - other.depths[other.leaf]))
        place = np.searchsorted(begins, occupied, side="right") - 1
        place = np.maximum(place, 0)
        inside = (begins[place] <= occupied) & (occupied < begins[place] + sizes[place])
        return int((~(inside & (other.values[other.leaf][place] >= 0.0))).sum())


def _read_tree(data: bytes) -> _Tree | None:
    """Read a tree from the bytes of an `.ot` file. Return None if the bytes are malformed."""
    _, marker, nodes = data.partition(b"\ndata\n")
    if not marker or not nodes or len(nodes) % _NODE.itemsize:
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
    """Fill the arrays `codes` and `depths`, of shape (n,), for the nodes in the order of the file.

    Returns the number of nodes in the tree, or 0 if the nodes do not form a tree.
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


# -- the kernels


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """One kernel, with everything that an isolated run of it needs.

    Attributes:
        name: value of `--kernel`.
        title: name in tables.
        prepare: does everything that precedes the kernel, and returns a function that calls the
            kernel on the given inputs.
        compare: returns the difference between the golden output and another one.
        tolerance: description of the differences that `compare` treats as unnoticeable.
        repeatable: true if the call leaves no state behind, so that extra calls can warm it up.
        too_long: true if the kernel is too long to be stepped whole; windows are sampled.
        inner: compiled functions at which windows begin, in addition to those of its scope.
        code: returns entry and scope of a plug-in kernel; called after the kernel has run.
        memory_mb: memory that a run may allocate beyond that of the loaded kernel, MB.
    """

    name: str
    title: str
    prepare: Callable[[KernelInputs], Call]
    compare: Callable[[Numbers, Numbers], Difference] = _numbers
    tolerance: str = f"numbers within {_SMALL:g} of their size"
    repeatable: bool = True
    too_long: bool = False
    inner: tuple[Any, ...] = ()
    code: Callable[[], KernelScope] | None = None
    memory_mb: int = 128

    @property
    def hang_s(self) -> float:
        """CPU time, in seconds, added to a multiple of the golden run's: the limit of a run.

        A run that uses more counts as hung.
        A runaway allocation fills the memory in a third of this time, so it crashes first.
        """
        return self.memory_mb / _FILLED_MB_PER_S

    def scope(self) -> KernelScope:
        """Find the kernel's entry and code in scope. The kernel must have run in this process."""
        from mavfi_cli.attack.kernels.scope import compiled_scope, kernel_scope

        scope = kernel_scope(self.name) if self.code is None else self.code()
        more = tuple(compiled_scope(self.name, function).entry for function in self.inner)
        return replace(scope, inner=(*scope.inner, *more))


def _point_cloud(inputs: KernelInputs) -> Call:
    params = point_cloud.PointCloudParams()

    def call() -> Output:
        """Convert one depth frame to points in the ENU frame, in metres."""
        cloud = point_cloud.generate(inputs.frame, params)
        return {"points_enu_m": cloud.points_enu_m, "origin_enu_m": cloud.origin_enu_m}

    return call


def _octomap(inputs: KernelInputs) -> Call:
    world = occupancy.OccupancyMap(occupancy.OccupancyParams())
    for cloud in inputs.mapped:
        world.insert(cloud)

    def call() -> Output:
        """Insert one more cloud into the map, and return the planner's map and the whole tree."""
        world.insert(inputs.cloud)
        payload = np.frombuffer(world.snapshot().payload, np.uint8)
        return {"payload": payload, "tree": lambda: np.frombuffer(world.tree(), np.uint8)}

    return call


def _collision_check(inputs: KernelInputs) -> Call:
    params, check = collision.CollisionParams(), inputs.check
    trajectory = check.trajectory
    assert trajectory is not None
    poses = np.linspace(check.time_s, trajectory.duration_s, _POSES, endpoint=False)

    def call() -> Output:
        """Check the rest of a trajectory from each of several poses along it."""
        state, reports = collision.CollisionState(), []
        for time_s in poses.tolist():
            state, report = collision.step(state, replace(check, time_s=time_s), params)
            reports.append(report)
        times_s = [report.time_to_collision_s for report in reports]
        blocked = [
            waypoint_index(trajectory, pose + time_s) if math.isfinite(time_s) else -1
            for pose, time_s in zip(poses.tolist(), times_s, strict=True)
        ]
        return {
            "collision": np.array([report.collision for report in reports]),
            "time_to_collision_s": np.array(times_s),
            "blocked_waypoint": np.array(blocked),
            "future_collision_seq": np.array([report.future_collision_seq for report in reports]),
        }

    return call


def _planner(name: str) -> Callable[[KernelInputs], Call]:
    def prepare(inputs: KernelInputs) -> Call:
        """Set up the planning problem of the recorded task, and return a call that solves it."""
        task, planner = inputs.task, planners.find(name)
        problem = PlanningProblem.pose(
            task.snapshot, task.start_enu_m, task.goal_enu_m, task.bounds_enu_m, PlanningParams()
        )

        def call() -> Output:
            """Search once, and return the path: (n, 3) vertices in the ENU frame, in metres."""
            result = planner.plan(problem, task.seed)
            return {"found": np.array(result.found), "path_enu_m": result.path_enu_m}

        return call

    return prepare


def _control(inputs: KernelInputs) -> Call:
    def call() -> Output:
        """Run one control tick, and return the command and the integral part of the PID."""
        state, command = tracking.step(
            inputs.tracking_state, inputs.tracking, inputs.tracking_params
        )
        return {
            "velocity_enu_mps": command.velocity_enu_mps,
            "acceleration_enu_mps2": command.acceleration_enu_mps2,
            "yaw_rad": np.array(command.yaw_rad),
            "integral_mps": state.integral_mps,
        }

    return call


def _planning(name: str, title: str, **others: Any) -> Kernel:
    return Kernel(
        name=name,
        title=title,
        prepare=_planner(name),
        compare=_paths,
        tolerance=f"a path within {_HALF_A_VOXEL_M:g} m, in length too",
        **others,
    )


KERNELS = {
    kernel.name: kernel
    for kernel in (
        Kernel(name="point_cloud", title="Point cloud", prepare=_point_cloud),
        Kernel(
            name="octomap",
            title="OctoMap",
            prepare=_octomap,
            compare=_maps,
            tolerance="the same voxels are occupied",
            repeatable=False,
            too_long=True,
        ),
        Kernel(
            name="collision_check",
            title="Collision check",
            prepare=_collision_check,
            compare=_checks,
            tolerance=f"the same collisions, within {_A_TICK_S:g} s",
            too_long=True,
        ),
        _planning("rrt", "RRT"),
        _planning("rrtconnect", "RRTConnect"),
        _planning("rrtstar", "RRT*", too_long=True, inner=(segment_free,)),
        Kernel(name="control", title="PID", prepare=_control),
    )
}


@functools.cache
def find(name: str) -> Kernel:
    """Return the built-in kernel `name`, or the `KERNEL` of the user's Python file at that path.

    Raises:
        UnknownName: no built-in kernel has this name.
        TargetError: the file is missing, cannot be loaded or defines no kernel.
    """
    if name.endswith(".py"):
        return _own(Path(name))
    try:
        return KERNELS[name]
    except KeyError:
        raise UnknownName("kernel", name, KERNELS) from None


def _own(path: Path) -> Kernel:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise TargetError(str(path), "no such file")
    sys.path.insert(0, str(path.parent))  # as for a script: modules next to it can be imported
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(path.stem, module)  # dataclasses look up their module there
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # the user's file may raise anything
        raise TargetError(str(path), f"cannot be loaded: {error!r}") from None
    kernel = getattr(module, "KERNEL", None)
    if not isinstance(kernel, Kernel):
        raise TargetError(str(path), "must define a Kernel named KERNEL")
    return kernel


def select(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the chosen built-in kernels, then the paths of the user's kernel files.

    The built-in kernels are in the order of the pipeline. If `names` is empty, all are returned.

    Raises:
        UnknownName: no built-in kernel has one of the names.
        TargetError: a file has no kernel, or several kernels share a name.
    """
    chosen = list(names)
    files = [str(Path(name).resolve()) for name in chosen if name.endswith(".py")]
    for file in files:
        find(file)
    wanted = {find(name).name for name in chosen if not name.endswith(".py")}
    if not chosen:
        wanted = set(KERNELS)
    ordered = (*(name for name in KERNELS if name in wanted), *dict.fromkeys(files))
    for name, count in Counter(find(kernel).name for kernel in ordered).items():
        if count > 1:
            raise TargetError(name, "more than one of the selected kernels has this name")
    return ordered
