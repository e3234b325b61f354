"""What the mission logic and the nodes that work for it say to each other."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.types import FloatArray, Trajectory


class Mode(Enum):
    """What the pilot is doing."""

    TURNING = "turning"  # hovering, looking all round before the first plan
    WAITING = "waiting"  # hovering, a plan is wanted
    FLYING = "flying"  # on a trajectory, nothing foreseen on it
    EVADING = "evading"  # on a blocked trajectory, with time to go on while a new one is planned
    SLOWING = "slowing"  # the same, with less time: at reduced speed
    STOPPING = "stopping"  # braking, then planning from a hover
    ARRIVED = "arrived"
    GAVE_UP = "gave_up"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest:
    """What a plan must connect, and what its maker must know."""

    stamp_s: float  # when the trajectory shall begin
    position_enu_m: FloatArray  # (3,)
    velocity_enu_mps: FloatArray  # (3,)
    yaw_rad: float
    goal_enu_m: FloatArray  # (3,)
    attempt: int  # counts all plans of the mission; seeds the planner
    trajectory_seq: int  # newest one known; the plan's own comes after it
    future_collision_seq: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanFailure:
    """A planner that found nothing."""

    stamp_s: float  # when the trajectory should have begun
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Directive:
    """What the control stage shall do in this tick."""

    mode: Mode
    trajectory: Trajectory | None  # None: hold `hold_enu_m`
    time_s: float  # point on the trajectory, from its first waypoint
    rate: float  # trajectory seconds per second, 0..1
    rate_change_per_s: float
    hold_enu_m: FloatArray  # (3,)
    hold_yaw_rad: float
    plan: PlanRequest | None = None
