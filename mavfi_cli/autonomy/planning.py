"""The planning stage: search a path, shorten it, smooth it into a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.planners.base import Planner, PlanningParams, pose_problem
from mavfi_cli.autonomy.shortcut import shortcut, subdivided
from mavfi_cli.autonomy.smoothing import Departure, Sequence, SmoothingParams, smooth
from mavfi_cli.core.types import FloatArray, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class StageParams:
    """Parameters of the planning stage."""

    clearance: PlanningParams = field(default_factory=PlanningParams)
    smoothing: SmoothingParams = field(default_factory=SmoothingParams)
    shortcut_spacing_m: float = 1.0  # vertex spacing of the path before the second shortcut


@dataclass(frozen=True, slots=True, kw_only=True)
class StageInputs:
    """One planning request with the newest map."""

    snapshot: MapSnapshot
    position_enu_m: FloatArray  # (3,) start of the trajectory
    departure: Departure  # stamp, velocity and yaw at the start
    goal_enu_m: FloatArray  # (3,)
    bounds_enu_m: FloatArray  # (6,) xmin ymin zmin xmax ymax zmax of the allowed volume
    sequence: Sequence
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StageOutput:
    """A trajectory, or None and the reason for the failure."""

    trajectory: Trajectory | None
    reason: str = ""
    path_enu_m: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (n, 3)


def plan(planner: Planner, inputs: StageInputs, params: StageParams) -> StageOutput:
    """Plan from the departure to the goal.

    If the vehicle departs in motion and cannot stop in free space, there is no trajectory. It must
    brake first.
    """
    problem = pose_problem(
        inputs.snapshot,
        inputs.position_enu_m,
        inputs.goal_enu_m,
        inputs.bounds_enu_m,
        params.clearance,
    )
    result = planner.plan(problem, inputs.seed)
    if not result.found:
        return StageOutput(trajectory=None, reason=result.reason)
    path = shortcut(result.path_enu_m, problem.grid)
    path = shortcut(subdivided(path, params.shortcut_spacing_m), problem.grid)
    smoothed = smooth(path, problem.grid, inputs.departure, inputs.sequence, params.smoothing)
    if not smoothed.free:
        return StageOutput(trajectory=None, reason="no free way on", path_enu_m=path)
    return StageOutput(trajectory=smoothed.trajectory, path_enu_m=path)
