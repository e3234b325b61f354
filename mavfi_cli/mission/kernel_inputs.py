"""Inputs of isolated kernels, recorded in a golden run that is flown once."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from mavfi_cli.attack.kernels.inputs import (
    INPUTS,
    KernelInputs,
    PlanningTask,
    load_inputs,
    save_inputs,
)
from mavfi_cli.autonomy import tracking
from mavfi_cli.autonomy.planners.base import PlanningParams, pose_problem
from mavfi_cli.companion.kernels import ControlInput
from mavfi_cli.core.errors import ConfigError, RecordError, TargetError
from mavfi_cli.core.seeds import Stream, derive
from mavfi_cli.mission.record.measures import record_of
from mavfi_cli.mission.recorder import Recorder
from mavfi_cli.mission.run import fly_golden
from mavfi_cli.spec.mission import MissionConfig


def record_inputs(config: MissionConfig) -> KernelInputs:
    """Fly the mission without a fault and return its kernels' inputs near the middle of the flight.

    Raises:
        TargetError: The flight did not reach its goal, or never had to plan round an obstacle.
        MavfiError: The mission could not begin.
    """
    recorder = Recorder()
    with tempfile.TemporaryDirectory(prefix="mavfi-golden-") as scratch:
        flight = record_of(fly_golden(config, Path(scratch), recorder))
    if not flight.succeeded:
        raise TargetError("golden flight", f"ended with {flight.outcome}: {flight.reason}")
    return _middle(flight_name(config), config, recorder)


def _middle(name: str, config: MissionConfig, recorder: Recorder) -> KernelInputs:
    given = {
        node: [value for value, _ in recorder.orders.get(node, [])]
        for node in ("point_cloud", "octomap", "control")
    }
    frames, clouds, ticks = given.values()
    if min(len(frames), len(clouds), len(ticks)) < 4:
        raise TargetError(name, "is too short to record kernels")
    cloud = len(clouds) // 2
    checks = recorder.orders.get("collision_check")
    if not checks:
        raise TargetError(name, "never checked a trajectory")
    check, stamp_s = checks[len(checks) // 2]
    state, inputs, params = _tracked(config, ticks)
    return KernelInputs(
        flight=name,
        frame=frames[len(frames) // 2],
        mapped=tuple(clouds[:cloud]),
        cloud=clouds[cloud],
        check=replace(check, stamp_s=stamp_s, front_enu_m=None),
        task=_hard_task(name, config, recorder),
        tracking_state=state,
        tracking=inputs,
        tracking_params=params,
    )


def _hard_task(name: str, config: MissionConfig, recorder: Recorder) -> PlanningTask:
    """Return the middle one of the requests that a straight line does not answer."""
    assert recorder.briefing is not None
    hard = []
    for (request, snapshot), _ in recorder.orders["planner"]:
        task = PlanningTask(
            snapshot=snapshot,
            start_enu_m=request.position_enu_m,
            goal_enu_m=request.goal_enu_m,
            bounds_enu_m=recorder.briefing.bounds_enu_m,
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
    config: MissionConfig, ticks: list[ControlInput]
) -> tuple[tracking.TrackingState, tracking.TrackingInputs, tracking.TrackingParams]:
    """Return state, input and parameters of the controller at the middle tick with a path."""
    params = tracking.TrackingParams(v_max_mps=config.v_max_mps, a_max_mps2=config.a_max_mps2)
    following = [index for index, tick in enumerate(ticks) if tick.inputs.trajectory is not None]
    if not following:
        raise TargetError("golden flight", "never followed a trajectory")
    first = ticks[0]
    state = tracking.TrackingState(yaw_rad=first.yaw_rad, stamp_s=first.inputs.stamp_s)
    chosen = following[len(following) // 2]
    for tick in ticks[:chosen]:
        state, _ = tracking.step(state, tick.inputs, params)
    return state, ticks[chosen].inputs, params


def inputs_of_flight(config: MissionConfig, folder: Path) -> dict[str, Any]:
    """Return the inputs of a golden run, from the folder or else from a flight.

    Returns:
        Arguments of a `KernelTarget` about its inputs: file, SHA-256, and flight in words.

    Raises:
        ConfigError: The folder contains the inputs of another flight.
    """
    path = folder / INPUTS
    if path.is_file():
        known, sha256 = load_inputs(path)
        if known.flight != flight_name(config):
            raise ConfigError(f"holds inputs of a {known.flight}", path=path)
        return {"inputs": path, "inputs_sha256": sha256, "flight": known.flight}
    inputs = record_inputs(config)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror}") from None
    sha256 = save_inputs(path, inputs)
    return {"inputs": path, "inputs_sha256": sha256, "flight": inputs.flight}


def flight_name(config: MissionConfig) -> str:
    """Describe a golden run in words."""
    return f"golden flight: world {config.world}, seed {config.seed}"
