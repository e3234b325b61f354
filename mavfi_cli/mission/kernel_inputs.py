"""Inputs of isolated kernels, recorded in golden runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from mavfi_cli.attack.kernels.inputs import (
    INPUTS,
    KernelInputs,
    PlanningTask,
    load_inputs,
    save_inputs,
)
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.autonomy import collision, tracking
from mavfi_cli.autonomy.collision import CollisionInputs
from mavfi_cli.autonomy.planners import PlanningParams, PlanningProblem
from mavfi_cli.companion.kernels import ControlInput
from mavfi_cli.core.errors import ConfigError, TargetError
from mavfi_cli.core.files import ScratchFolder, writing
from mavfi_cli.core.seeds import Stream
from mavfi_cli.mission.progress import Recorder
from mavfi_cli.mission.run import fly_golden
from mavfi_cli.spec.mission import MissionConfig

_Any = TypeVar("_Any")
INPUTS_A_KERNEL = 5
_FORESEEN = 2  # colliding trajectories among the five checked, if the flight has that many
_FLIGHTS = 20  # maximum number of flights to search for planning problems


def record_inputs(config: MissionConfig) -> tuple[KernelInputs, ...]:
    """Fly a golden run and return inputs of all kernels, spread over the flight.

    Every member of the result has one input per kernel. If the flight has too few planning problems
    with obstacles, flights with the next seeds supply the rest.

    Raises:
        TargetError: A flight did not reach its goal, or it has too few inputs of a kernel.
        MavfiError: The mission could not begin.
    """
    name, recorder = _flight_name(config), _flown(config)
    given = {
        node: [value for value, _ in recorder.orders.get(node, [])]
        for node in ("point_cloud", "octomap", "control")
    }
    frames, clouds, ticks = given.values()
    if min(len(frames), len(clouds), len(ticks)) < 2 * INPUTS_A_KERNEL:
        raise TargetError(name, "the flight is too short to record inputs; choose another seed")
    params = tracking.TrackingParams(v_max_mps=config.v_max_mps, a_max_mps2=config.a_max_mps2)
    kernels = zip(
        _spread(frames),
        _spread(range(len(clouds))),
        _checks(name, recorder),
        _problems(config, recorder),
        _tracked(name, ticks, params),
        strict=True,
    )
    return tuple(
        KernelInputs(
            flight=name,
            frame=frame,
            mapped=tuple(clouds[:cloud]),
            cloud=clouds[cloud],
            check=check,
            task=task,
            tracking_state=state,
            tracking=inputs,
            tracking_params=params,
        )
        for frame, cloud, check, task, (state, inputs) in kernels
    )


def _flown(config: MissionConfig) -> Recorder:
    recorder = Recorder()
    with ScratchFolder("golden") as scratch:
        flight = fly_golden(config, scratch, recorder).record
    if not flight.succeeded:
        problem = f"ended with {flight.outcome}: {flight.reason}"
        raise TargetError(_flight_name(config), problem)
    return recorder


def _spread(of: Sequence[_Any], number: int = INPUTS_A_KERNEL) -> list[_Any]:
    """Return `number` equally spaced members of a sequence.

    If `number` is odd, they include the middle one.
    """
    return [of[(2 * k + 1) * len(of) // (2 * number)] for k in range(number)]


def _checks(name: str, recorder: Recorder) -> list[CollisionInputs]:
    """Return recorded inputs of the collision check.

    Up to _FORESEEN of them, if the flight has that many, have a trajectory that collides.
    """
    free: list[CollisionInputs] = []
    foreseen: list[CollisionInputs] = []
    for check, stamp_s in recorder.orders.get("collision_check", []):
        if check.trajectory is not None:
            alone = replace(check, stamp_s=stamp_s, front_enu_m=None)
            state, params = collision.CollisionState(), collision.CollisionParams()
            _, report = collision.step(state, alone, params)
            (foreseen if report.collision else free).append(alone)
    some = min(_FORESEEN, len(foreseen))
    if len(free) < INPUTS_A_KERNEL - some:
        raise TargetError(name, "too few checked trajectories were free; choose another seed")
    return _spread(free, INPUTS_A_KERNEL - some) + _spread(foreseen, some)


def _problems(config: MissionConfig, recorder: Recorder) -> list[PlanningTask]:
    tasks = _hard_tasks(config, recorder)
    for seed in range(config.seed + 1, config.seed + _FLIGHTS):
        if len(tasks) >= INPUTS_A_KERNEL:
            break
        another = replace(config, seed=seed)
        tasks += _hard_tasks(another, _flown(another))
    if len(tasks) >= INPUTS_A_KERNEL:
        return _spread(tasks)
    raise TargetError(
        _flight_name(config),
        "the planner had to avoid obstacles too few times, even in flights with the next seeds; "
        "choose another world",
    )


def _hard_tasks(config: MissionConfig, recorder: Recorder) -> list[PlanningTask]:
    """Return the planning requests that need a detour around an obstacle.

    Their start and goal are free, but the straight line between them is not.
    """
    assert recorder.briefing is not None
    hard = []
    for (request, snapshot), _ in recorder.orders["planner"]:
        task = PlanningTask(
            snapshot=snapshot,
            start_enu_m=request.position_enu_m,
            goal_enu_m=request.goal_enu_m,
            bounds_enu_m=recorder.briefing.bounds_enu_m,
            seed=Stream.PLANNER.seed(config.seed, request.attempt),
        )
        grid = PlanningProblem.pose(
            snapshot, task.start_enu_m, task.goal_enu_m, task.bounds_enu_m, PlanningParams()
        ).grid
        start, goal = task.start_enu_m, task.goal_enu_m
        ends_free = grid.point_free(goal) and grid.point_free(start)
        if ends_free and not grid.segment_free(start, goal):
            hard.append(task)
    return hard


def _tracked(
    name: str, ticks: list[ControlInput], params: tracking.TrackingParams
) -> list[tuple[tracking.TrackingState, tracking.TrackingInputs]]:
    """Return pairs of state and input of the controller, at ticks in which it had a trajectory."""
    following = [index for index, tick in enumerate(ticks) if tick.inputs.trajectory is not None]
    if not following:
        raise TargetError(name, "the vehicle never followed a trajectory")
    first = ticks[0]
    state = tracking.TrackingState(yaw_rad=first.yaw_rad, stamp_s=first.inputs.stamp_s)
    chosen, tracked = _spread(following), []
    for index, tick in enumerate(ticks[: chosen[-1] + 1]):
        tracked += [(state, tick.inputs)] * chosen.count(index)
        state, _ = tracking.step(state, tick.inputs, params)
    return tracked


def kernel_targets(
    kernels: Iterable[str], config: MissionConfig, folder: Path, tolerance: float = 0.0
) -> list[KernelTarget]:
    """Return an attack target for each named kernel, with inputs recorded in a golden run.

    The inputs are read from the folder. If it contains none, they are recorded in a flight and
    stored there.

    Args:
        config: Mission of the golden run.
        tolerance: As for `KernelTarget`.

    Raises:
        ConfigError: The folder contains inputs from another flight.
    """
    path = folder / INPUTS
    if not path.is_file():
        inputs = record_inputs(config)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        save_inputs(path, inputs)
    (known, *_), sha256 = load_inputs(path)
    if known.flight != _flight_name(config):
        raise ConfigError(f"the inputs come from another flight, the {known.flight}", path=path)
    return [
        KernelTarget(
            kernel=kernel,
            tolerance=tolerance,
            inputs=path,
            inputs_sha256=sha256,
            flight=known.flight,
        )
        for kernel in kernels
    ]


def kernel_flight(world: str = "dense", seed: int = 3) -> MissionConfig:
    """Return the mission of the golden run that provides the kernels' inputs for `mavfi kernels`.

    Collision check, planner and control use the parameters of the stack `hardened`.
    """
    return MissionConfig(world=world, seed=seed, stack="hardened")


def _flight_name(config: MissionConfig) -> str:
    return f"golden flight: world {config.world}, seed {config.seed}"
