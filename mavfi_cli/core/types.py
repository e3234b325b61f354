"""Messages between kernels: frozen records in SI units, ENU world frame and FLU body frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Stage(Enum):
    """The three stages of the perception-planning-control pipeline."""

    PERCEPTION = "perception"
    PLANNING = "planning"
    CONTROL = "control"


class Outcome(Enum):
    """Outcome of a mission."""

    SUCCESS = "success"
    COLLISION = "collision"
    NO_PATH = "no_path"
    TIMEOUT = "timeout"
    FAILSAFE = "failsafe"
    LINK_LOST = "link_lost"
    CRASH = "crash"
    HANG = "hang"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, slots=True, kw_only=True)
class Briefing:
    """Start, goal, flight bounds and camera of a mission, known before the flight."""

    start_enu_m: FloatArray  # (3,) on the ground
    goal_enu_m: FloatArray  # (3,)
    bounds_enu_m: FloatArray  # (6,) xmin ymin zmin xmax ymax zmax of the allowed volume
    camera_offset_flu_m: FloatArray  # (3,) from the vehicle's centre to the optical centre
    hfov_rad: float = math.pi / 2.0  # used until the camera reports its own


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """State of the vehicle at one stamp, from its MAVLink messages."""

    stamp_s: float  # vehicle boot clock
    position_enu_m: FloatArray  # (3,)
    velocity_enu_mps: FloatArray  # (3,)
    quaternion: FloatArray  # (4,) w x y z, body FLU -> ENU
    yaw_rad: float  # from east, counter-clockwise


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFrame:
    """One depth image with the camera's pose when it was taken."""

    stamp_s: float
    depth_m: FloatArray  # (rows, columns) along the optical axis; inf where nothing was in range
    hfov_rad: float
    position_enu_m: FloatArray  # (3,) optical centre
    quaternion: FloatArray  # (4,) camera FLU -> ENU


@dataclass(frozen=True, slots=True, kw_only=True)
class PointCloud:
    """Points that a sensor measured, in the world frame."""

    stamp_s: float
    points_enu_m: FloatArray  # (n, 3)
    origin_enu_m: FloatArray  # (3,) sensor position, where the rays start


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionReport:
    """Result of the collision check of the whole remaining trajectory."""

    stamp_s: float
    collision: bool
    time_to_collision_s: float  # inf if the trajectory is free
    future_collision_seq: int  # number of collisions predicted so far


WAYPOINT_FIELDS = ("x", "y", "z", "yaw", "vx", "vy", "vz", "ax", "ay", "az")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """A time-parametrised path of waypoints with equal or unequal durations."""

    stamp_s: float  # start of the first waypoint
    waypoints: FloatArray  # (n, 10) in the order of WAYPOINT_FIELDS; m, rad, m/s, m/s^2, ENU
    durations_s: FloatArray  # (n,) duration of each waypoint
    trajectory_seq: int
    future_collision_seq: int  # the newest predicted collision that the planner knew of

    @property
    def duration_s(self) -> float:
        """Return the time from the start of the first waypoint to the end of the last, s."""
        return float(self.durations_s.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Command of the control stage to the flight controller."""

    stamp_s: float
    velocity_enu_mps: FloatArray  # (3,)
    yaw_rad: float
    acceleration_enu_mps2: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,)
    pace: float = 1.0  # rate of the trajectory's clock while this command holds, 0..1
    skips_waypoint: bool = False  # True ends the current waypoint


@dataclass(frozen=True, slots=True, kw_only=True)
class Invocation:
    """A row of the timetable: node, start and end of an invocation."""

    node: str
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reaction:
    """Response of the pipeline to one depth frame."""

    frame_stamp_s: float
    setpoint_stamp_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StackMark:
    """Identity of the companion's stack. Error-free flights differ between stacks.

    Attributes:
        digest: SHA-256 of its settings. Equal digests mean equal stacks.
    """

    name: str
    digest: str
