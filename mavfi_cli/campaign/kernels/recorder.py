"""Fly a golden mission once and keep what its kernels were fed."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mavfi_cli.autonomy import planners, tracking, warm_up
from mavfi_cli.autonomy.collision import CollisionInputs
from mavfi_cli.autonomy.orders import Directive, PlanRequest
from mavfi_cli.autonomy.planners.base import PlanningParams, pose_problem
from mavfi_cli.campaign.kernels.inputs import (
    INPUTS,
    KernelInputs,
    PlanningTask,
    load_inputs,
    save_inputs,
)
from mavfi_cli.core.errors import ConfigError, MavfiError, RecordError, TargetError
from mavfi_cli.core.seeds import Stream, derive
from mavfi_cli.core.types import Command, DepthFrame, FloatArray, Outcome, PointCloud, VehicleState
from mavfi_cli.link.transport import open_transport
from mavfi_cli.mission import briefing
from mavfi_cli.mission.companion.companion import Companion
from mavfi_cli.mission.companion.kernels import tracking_inputs
from mavfi_cli.mission.config import MissionConfig, stack_of
from mavfi_cli.mission.flight import Flight
from mavfi_cli.mission.platform import load_platform
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.vehicle_process import VehicleProcess


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tick:
    stamp_s: float
    state: VehicleState
    directive: Directive

    @property
    def inputs(self) -> tracking.TrackingInputs:
        """What control was given."""
        return tracking_inputs(self.stamp_s, self.state, self.directive)


@dataclass(slots=True)
class _Recording:
    """Inputs of every invocation, in order."""

    frames: list[DepthFrame] = field(default_factory=list)
    clouds: list[PointCloud] = field(default_factory=list)
    checks: list[tuple[Any, float]] = field(default_factory=list)
    jobs: list[tuple[PlanRequest, Any]] = field(default_factory=list)
    ticks: list[_Tick] = field(default_factory=list)
    bounds_enu_m: FloatArray | None = None


def record_inputs(config: MissionConfig) -> KernelInputs:
    """Fly the mission without a fault; the inputs of its kernels around the middle of the flight.

    Raises:
        TargetError: the flight did not reach its goal, or never had to plan round anything.
        MavfiError: the mission could not begin.
    """
    recording = _Recording()
    _fly(config, recording)
    name = flight_name(config)
    if min(len(recording.frames), len(recording.clouds), len(recording.ticks)) < 4:
        raise TargetError(name, "is too short to record kernels")
    return _middle(name, config, recording)


def _fly(config: MissionConfig, recording: _Recording) -> None:
    with tempfile.TemporaryDirectory(prefix="mavfi-golden-") as scratch:
        folder = Path(scratch)
        process = VehicleProcess(config, folder)
        transport = open_transport(f"fd:{process.detach()}")
        try:
            warm_up()
            planner = planners.find(config.planner)
            platform = load_platform(config.platform)
            flight = Flight(config, stack_of(config), transport, platform, planner, Watcher(), [])
            try:
                flight.connect()
                told = briefing.of_simulation(folder)
                flight.brief(told)
            except MavfiError:
                transport.close()
                process.stop()
                raise (process.failure() or TargetError("golden flight", "did not begin")) from None
            assert flight.companion is not None
            recording.bounds_enu_m = told.bounds_enu_m
            _listen(flight.companion, recording)
            flight.fly(folder / "flight.tlog")
        finally:
            transport.close()
            process.stop()
            process.close()
    if flight.outcome is not Outcome.SUCCESS:
        outcome = "nothing" if flight.outcome is None else flight.outcome.value
        raise TargetError("golden flight", f"ended with {outcome}: {flight.reason}")


def _listen(companion: Companion, recording: _Recording) -> None:
    """Have the companion's kernels write down what they are given."""
    nodes = companion.executor.nodes

    def tap(name: str, note: Callable[[Any, float], None]) -> None:
        """Have a note taken of every input of a node."""
        run = nodes[name].run

        def noted(value: Any, stamp_s: float) -> Any:
            """The kernel's own work, its input and start stamp noted."""
            note(value, stamp_s)
            return run(value, stamp_s)

        nodes[name].run = noted

    tap("point_cloud", lambda frame, _stamp_s: recording.frames.append(frame))
    tap("octomap", lambda cloud, _stamp_s: recording.clouds.append(cloud))
    tap("collision_check", lambda check, stamp_s: recording.checks.append((check, stamp_s)))
    tap("planner", lambda job, _stamp_s: recording.jobs.append(job))
    tick = companion.tick

    def noted_tick(stamp_s: float, state: VehicleState) -> Command | None:
        """The companion's own tick; noted where the pilot decided something in it."""
        before = companion.directive
        command = tick(stamp_s, state)
        if companion.directive is not None and companion.directive is not before:
            recording.ticks.append(
                _Tick(stamp_s=stamp_s, state=state, directive=companion.directive)
            )
        return command

    companion.tick = noted_tick  # type: ignore[method-assign]


def _middle(name: str, config: MissionConfig, recording: _Recording) -> KernelInputs:
    cloud = len(recording.clouds) // 2
    checks = [entry for entry in recording.checks if entry[0].trajectory is not None]
    if not checks:
        raise TargetError(name, "never checked a trajectory")
    check, stamp_s = checks[len(checks) // 2]
    state, inputs, params = _tracked(config, recording.ticks)
    return KernelInputs(
        flight=name,
        frame=recording.frames[len(recording.frames) // 2],
        mapped=tuple(recording.clouds[:cloud]),
        cloud=recording.clouds[cloud],
        check=CollisionInputs(
            stamp_s=stamp_s,
            snapshot=check.snapshot,
            trajectory=check.trajectory,
            time_s=check.time_s,
        ),
        task=_hard_task(name, config, recording),
        tracking_state=state,
        tracking=inputs,
        tracking_params=params,
    )


def _hard_task(name: str, config: MissionConfig, recording: _Recording) -> PlanningTask:
    """The middle one of the requests that a straight line does not answer."""
    assert recording.bounds_enu_m is not None
    hard = []
    for request, snapshot in recording.jobs:
        task = PlanningTask(
            snapshot=snapshot,
            start_enu_m=request.position_enu_m,
            goal_enu_m=request.goal_enu_m,
            bounds_enu_m=recording.bounds_enu_m,
            seed=derive(config.seed, Stream.PLANNER, request.attempt),
        )
        grid = pose_problem(
            snapshot, task.start_enu_m, task.goal_enu_m, task.bounds_enu_m, PlanningParams()
        ).grid
        if grid.point_free(task.goal_enu_m) and grid.point_free(task.start_enu_m):
            if grid.segment_free(task.start_enu_m, task.goal_enu_m):
                continue
            hard.append(task)
    if not hard:
        raise TargetError(name, "never had to plan round an obstacle")
    return hard[len(hard) // 2]


def _tracked(
    config: MissionConfig, ticks: list[_Tick]
) -> tuple[tracking.TrackingState, tracking.TrackingInputs, tracking.TrackingParams]:
    """State, input and parameters of the controller at the middle tick that follows a path."""
    params = tracking.TrackingParams(v_max_mps=config.v_max_mps, a_max_mps2=config.a_max_mps2)
    following = [index for index, tick in enumerate(ticks) if tick.directive.trajectory is not None]
    if not following:
        raise TargetError("golden flight", "never followed a trajectory")
    first = ticks[0]
    state = tracking.TrackingState(yaw_rad=first.state.yaw_rad, stamp_s=first.stamp_s)
    chosen = following[len(following) // 2]
    for tick in ticks[:chosen]:
        state, _ = tracking.step(state, tick.inputs, params)
    return state, ticks[chosen].inputs, params


def inputs_of_flight(config: MissionConfig, folder: Path) -> tuple[Path, str, str]:
    """The inputs of a golden flight: from the folder where it has them, else flown now.

    Returns:
        The file, the flight in words, and the file's SHA-256.

    Raises:
        ConfigError: the folder has the inputs of another flight.
    """
    path = folder / INPUTS
    if path.is_file():
        known, sha256 = load_inputs(path)
        if known.flight != flight_name(config):
            raise ConfigError(f"holds inputs of a {known.flight}", path=path)
        return path, known.flight, sha256
    inputs = record_inputs(config)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror}") from None
    return path, inputs.flight, save_inputs(path, inputs)


def flight_name(config: MissionConfig) -> str:
    """A golden flight in words."""
    return f"golden flight: world {config.world}, seed {config.seed}"
