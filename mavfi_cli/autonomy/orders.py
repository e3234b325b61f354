"""Messages between the mission logic and the planner."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.types import FloatArray


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
class Departure:
    """Start of a trajectory: state of motion and sequence numbers."""

    stamp_s: float
    velocity_enu_mps: FloatArray  # (3,)
    yaw_rad: float
    trajectory_seq: int = 0
    future_collision_seq: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest(Departure):
    """Request for a trajectory from a position to the goal.

    `trajectory_seq` is the newest known number; the planner's node takes the next.
    """

    position_enu_m: FloatArray  # (3,)
    goal_enu_m: FloatArray  # (3,)
    attempt: int  # number of the plan in the mission; seeds the planner


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanFailure:
    """Report that the planner found no trajectory."""

    stamp_s: float  # requested start of the trajectory
    reason: str
