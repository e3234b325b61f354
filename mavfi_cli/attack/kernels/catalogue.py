"""The kernels that can be attacked in isolation: how they are called and their outputs compared."""

from __future__ import annotations

import functools
import importlib.util
import io
import math
import sys
import tokenize
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.attack.kernels.inputs import KernelInputs
from mavfi_cli.attack.kernels.scope import KernelScope, compiled_region, kernel_scope
from mavfi_cli.attack.target import Difference
from mavfi_cli.autonomy import collision, occupancy, planners, point_cloud, tracking
from mavfi_cli.autonomy.grid import segment_free
from mavfi_cli.autonomy.octree import occupied_leaves
from mavfi_cli.autonomy.planners.base import PlanningParams, pose_problem
from mavfi_cli.core.errors import TargetError, UnknownName

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


Call = Callable[[], Output]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """One kernel with everything that an isolated run of it needs.

    Attributes:
        name: as `--kernel` takes it.
        title: as tables print it.
        prepare: function from the inputs to a call; everything before the kernel itself runs here.
        compare: function that returns the size of the difference of two outputs.
        repeatable: true if the call leaves no state behind, so that calling it warms it up.
        too_long: true if the kernel is too long to be stepped whole; windows are sampled.
        inner: compiled functions at which windows begin, beside those of its scope.
        code: for a plug-in kernel, function that returns entry and scope; called after it has run.
    """

    name: str
    title: str
    prepare: Callable[[KernelInputs], Call]
    compare: Compare = numbers
    repeatable: bool = True
    too_long: bool = False
    inner: tuple[Any, ...] = ()
    code: Callable[[], KernelScope] | None = None

    def scope(self) -> KernelScope:
        """The machine code that can be hit, in a process in which the kernel has run."""
        found = kernel_scope(self.name) if self.code is None else self.code()
        more = tuple(compiled_region(function)[1] for function in self.inner)
        return replace(found, inner=(*found.inner, *more))


def _point_cloud(inputs: KernelInputs) -> Call:
    params = point_cloud.PointCloudParams()

    def call() -> Output:
        """Convert one depth frame to points, ENU, m."""
        cloud = point_cloud.generate(inputs.frame, params)
        return {"points_enu_m": cloud.points_enu_m, "origin_enu_m": cloud.origin_enu_m}

    return call


def _octomap(inputs: KernelInputs) -> Call:
    world = occupancy.OccupancyMap(occupancy.OccupancyParams())
    for cloud in inputs.mapped:
        world.insert(cloud)

    def call() -> Output:
        """Insert one more cloud into the map; return its serialised tree and number of nodes."""
        world.insert(inputs.cloud)
        payload = np.frombuffer(world.snapshot().payload, np.uint8)
        return {"payload": payload, "nodes": np.array(world.nodes)}

    return call


def _collision_check(inputs: KernelInputs) -> Call:
    params = collision.CollisionParams()

    def call() -> Output:
        """Check the rest of a trajectory once."""
        _, report = collision.step(collision.CollisionState(), inputs.check, params)
        return {
            "collision": np.array(report.collision),
            "time_to_collision_s": np.array(report.time_to_collision_s),
            "future_collision_seq": np.array(report.future_collision_seq),
        }

    return call


def _planner(name: str) -> Callable[[KernelInputs], Call]:
    def prepare(inputs: KernelInputs) -> Call:
        """Prepare a planner's call on the recorded task, with the problem already set up."""
        task, planner = inputs.task, planners.find(name)
        problem = pose_problem(
            task.snapshot, task.start_enu_m, task.goal_enu_m, task.bounds_enu_m, PlanningParams()
        )

        def call() -> Output:
            """Search once; return the path (n, 3), ENU, m."""
            result = planner.plan(problem, task.seed)
            return {"found": np.array(result.found), "path_enu_m": result.path_enu_m}

        return call

    return prepare


def _control(inputs: KernelInputs) -> Call:
    def call() -> Output:
        """Run one control tick; return the command and the integral part of its PID."""
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


KERNELS = {
    kernel.name: kernel
    for kernel in (
        Kernel(name="point_cloud", title="Point cloud", prepare=_point_cloud),
        Kernel(
            name="octomap",
            title="OctoMap",
            prepare=_octomap,
            compare=voxels,
            repeatable=False,
            too_long=True,
        ),
        Kernel(
            name="collision_check", title="Collision check", prepare=_collision_check, too_long=True
        ),
        Kernel(name="rrt", title="RRT", prepare=_planner("rrt"), compare=paths),
        Kernel(
            name="rrtconnect", title="RRTConnect", prepare=_planner("rrtconnect"), compare=paths
        ),
        Kernel(
            name="rrtstar",
            title="RRT*",
            prepare=_planner("rrtstar"),
            compare=paths,
            too_long=True,
            inner=(segment_free,),
        ),
        Kernel(name="control", title="PID", prepare=_control),
    )
}


@functools.cache
def find(name: str) -> Kernel:
    """Find a kernel by its name, or the `KERNEL` of a user's Python file.

    Raises:
        UnknownName: there is no such kernel; names the nearest.
        TargetError: the file has no kernel.
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
    sys.path.insert(0, str(path.parent))  # as for a script: modules beside it can be imported
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # the user's file may raise anything
        raise TargetError(str(path), f"cannot be loaded: {error!r}") from None
    kernel = getattr(module, "KERNEL", None)
    if not isinstance(kernel, Kernel):
        raise TargetError(str(path), "has no Kernel of the name KERNEL")
    return kernel


def select(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names by which `find` knows the kernels; all of ours if none is named.

    Ours come first, in the order of the pipeline.

    Raises:
        UnknownName: there is no kernel of a name; names the nearest.
    """
    chosen = list(names)
    files = [str(Path(name).resolve()) for name in chosen if name.endswith(".py")]
    wanted = {find(name).name for name in chosen if not name.endswith(".py")}
    if not chosen:
        wanted = set(KERNELS)
    return (*(name for name in KERNELS if name in wanted), *dict.fromkeys(files))
