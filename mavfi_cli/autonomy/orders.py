"""Messages between the mission logic and the planning and control nodes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.types import FloatArray, Trajectory


class PilotMode(Enum):
    """Mode of the pilot."""

    TURNING = "turning"  # hovers and turns once round before the first plan
    WAITING = "waiting"  # hovers and waits for a plan
    FLYING = "flying"  # follows a trajectory without a predicted collision
    EVADING = "evading"  # follows a blocked trajectory at full speed while a new one is planned
    SLOWING = "slowing"  # follows a blocked trajectory at reduced speed, as there is less time
    STOPPING = "stopping"  # brakes, then plans from a hover
    ARRIVED = "arrived"
    GAVE_UP = "gave_up"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest:
    """Request for a trajectory."""

    stamp_s: float  # start of the trajectory
    position_enu_m: FloatArray  # (3,)
    velocity_enu_mps: FloatArray  # (3,)
    yaw_rad: float
    goal_enu_m: FloatArray  # (3,)
    attempt: int  # number of the plan in the mission; seeds the planner
    trajectory_seq: int  # newest known number; the plan takes the next
    future_collision_seq: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanFailure:
    """Report that the planner found no trajectory."""

    stamp_s: float  # requested start of the trajectory
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Directive:
    """Input of the control stage in one tick."""

    mode: PilotMode
    trajectory: Trajectory | None  # None: hold `hold_enu_m`
    time_s: float  # point on the trajectory, from its first waypoint
    rate: float  # trajectory seconds per second, 0..1
    rate_change_per_s: float
    hold_enu_m: FloatArray  # (3,)
    hold_yaw_rad: float
    plan: PlanRequest | None = None
