"""The kernels that can be attacked in isolation: how they are called and their outputs compared."""

from __future__ import annotations

import functools
import importlib.util
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.attack.comparison import Difference
from mavfi_cli.attack.kernels.inputs import KernelInputs
from mavfi_cli.attack.kernels.outputs import (
    A_TICK_S,
    HALF_A_VOXEL_M,
    SMALL,
    Numbers,
    Output,
    checks,
    maps,
    numbers,
    paths,
)
from mavfi_cli.autonomy import collision, occupancy, planners, point_cloud, tracking
from mavfi_cli.autonomy.grid import segment_free
from mavfi_cli.autonomy.planners import PlanningParams, PlanningProblem
from mavfi_cli.autonomy.tracking import waypoint_index
from mavfi_cli.core.errors import TargetError, UnknownName

if TYPE_CHECKING:
    from mavfi_cli.attack.kernels.scope import KernelScope

Call = Callable[[], Output]
_FILLED_MB_PER_S = 512  # by a loop that allocates, at least
_POSES = 5  # from which the collision check looks ahead


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """One kernel with everything that an isolated run of it needs.

    Attributes:
        name: as `--kernel` takes it.
        title: as tables print it.
        prepare: function from the inputs to a call; everything before the kernel itself runs here.
        compare: function that returns the size of the difference of two outputs.
        tolerance: which differences `compare` does not call noticeable, in words.
        repeatable: true if the call leaves no state behind, so that calling it warms it up.
        too_long: true if the kernel is too long to be stepped whole; windows are sampled.
        inner: compiled functions at which windows begin, beside those of its scope.
        code: for a plug-in kernel, function that returns entry and scope; called after it has run.
        memory_mb: memory that a run may take beyond that of the loaded kernel.
    """

    name: str
    title: str
    prepare: Callable[[KernelInputs], Call]
    compare: Callable[[Numbers, Numbers], Difference] = numbers
    tolerance: str = f"numbers within {SMALL:g} of their size"
    repeatable: bool = True
    too_long: bool = False
    inner: tuple[Any, ...] = ()
    code: Callable[[], KernelScope] | None = None
    memory_mb: int = 128

    @property
    def hang_s(self) -> float:
        """CPU time beyond its golden one after which a run hangs.

        A runaway fills its memory three times as fast, so it ends as a crash, never as a hang.
        """
        return self.memory_mb / _FILLED_MB_PER_S

    def scope(self) -> KernelScope:
        """The machine code that can be hit, in a process in which the kernel has run."""
        from mavfi_cli.attack.kernels.scope import compiled_region, kernel_scope

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
        """Insert one more cloud into the map; return the planner's map and the whole tree."""
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
        """Check the rest of a trajectory from several poses on it."""
        state, reports = collision.CollisionState(), []
        for time_s in poses.tolist():
            state, report = collision.step(state, replace(check, time_s=time_s), params)
            reports.append(report)
        times_s = [each.time_to_collision_s for each in reports]
        blocked = [
            waypoint_index(trajectory, pose + time_s) if math.isfinite(time_s) else -1
            for pose, time_s in zip(poses.tolist(), times_s, strict=True)
        ]
        return {
            "collision": np.array([each.collision for each in reports]),
            "time_to_collision_s": np.array(times_s),
            "blocked_waypoint": np.array(blocked),
            "future_collision_seq": np.array([each.future_collision_seq for each in reports]),
        }

    return call


def _planner(name: str) -> Callable[[KernelInputs], Call]:
    def prepare(inputs: KernelInputs) -> Call:
        """Prepare a planner's call on the recorded task, with the problem already set up."""
        task, planner = inputs.task, planners.find(name)
        problem = PlanningProblem.pose(
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


def _planning(name: str, title: str, **others: Any) -> Kernel:
    return Kernel(
        name=name,
        title=title,
        prepare=_planner(name),
        compare=paths,
        tolerance=f"a path within {HALF_A_VOXEL_M:g} m, in length too",
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
            compare=maps,
            tolerance="the same voxels are occupied",
            repeatable=False,
            too_long=True,
        ),
        Kernel(
            name="collision_check",
            title="Collision check",
            prepare=_collision_check,
            compare=checks,
            tolerance=f"the same collisions, within {A_TICK_S:g} s",
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
    sys.modules.setdefault(path.stem, module)  # dataclasses look up their module there
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
        TargetError: a file has no kernel, or several kernels have one name.
    """
    chosen = list(names)
    files = [str(Path(name).resolve()) for name in chosen if name.endswith(".py")]
    for file in files:
        find(file)
    wanted = {find(name).name for name in chosen if not name.endswith(".py")}
    if not chosen:
        wanted = set(KERNELS)
    found = (*(name for name in KERNELS if name in wanted), *dict.fromkeys(files))
    for name, count in Counter(find(each).name for each in found).items():
        if count > 1:
            raise TargetError(name, "several kernels have this name")
    return found
