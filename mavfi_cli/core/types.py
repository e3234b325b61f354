"""Messages between kernels, and the table of their monitored states.

Messages are frozen records in SI units, ENU world frame and FLU body frame. A state is a scalar, or
one component of a vector, that one kernel passes to the next. The packages fi, detect and report
iterate over the table. All reads and writes of a state go through it, so only the table depends on
where the state is stored.
Source of the list: the paper, sections IV-C and V-A, and the messages of its released code
(MAVBench/MAV_apps, branch mavfi).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
KERNELS = ("point_cloud", "octomap", "collision_check", "planner", "control")  # in flow order


class Stage(Enum):
    """The three stages of the perception-planning-control pipeline."""

    PERCEPTION = "perception"
    PLANNING = "planning"
    CONTROL = "control"

    @property
    def states(self) -> tuple[State, ...]:
        """The states that the stage outputs, in the order of the table STATES."""
        return tuple(state for state in STATES if state.stage is self)


class Outcome(Enum):
    """How a mission ended."""

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
    """What the companion knows about a mission before take-off: start, goal, bounds and camera."""

    start_enu_m: FloatArray  # (3,) on the ground
    goal_enu_m: FloatArray  # (3,)
    bounds_enu_m: FloatArray  # (6,) xmin ymin zmin xmax ymax zmax of the allowed volume
    camera_offset_flu_m: FloatArray  # (3,) from the vehicle's centre to the optical centre
    hfov_rad: float = math.pi / 2.0  # horizontal field of view, used until the camera reports one


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightTruth:
    """The true states and other data that the vehicle's side recorded during a flight.

    Attributes:
        log: The referee's log: columns of shape (n,), (n, 3) or (n, 4), with one row per control
            tick, keyed by name.
        report: The referee's report: the section `referee` of a record, and the `world`.
        stage_wall_s: Wall-clock time, in seconds, of each part of the simulation.
        memory_mb: Peak memory of the process, in MB.
    """

    log: Mapping[str, FloatArray]
    report: Mapping[str, Any]
    stage_wall_s: Mapping[str, float] = field(default_factory=dict)
    memory_mb: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """The state of the vehicle at one time, as its MAVLink messages report it."""

    stamp_s: float  # vehicle boot clock
    position_enu_m: FloatArray  # (3,)
    velocity_enu_mps: FloatArray  # (3,)
    quaternion: FloatArray  # (4,) w x y z, body FLU -> ENU
    yaw_rad: float  # from east, counter-clockwise


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFrame:
    """One depth image, and the pose of the camera when it was taken."""

    stamp_s: float
    depth_m: FloatArray  # (rows, columns) along the optical axis; inf where nothing was in range
    hfov_rad: float
    position_enu_m: FloatArray  # (3,) optical centre
    quaternion: FloatArray  # (4,) camera FLU -> ENU


@dataclass(frozen=True, slots=True, kw_only=True)
class PointCloud:
    """The points that the depth camera measured in one frame, in the world frame."""

    stamp_s: float
    points_enu_m: FloatArray  # (n, 3)
    origin_enu_m: FloatArray  # (3,) sensor position, where the rays start


@dataclass(frozen=True, slots=True, kw_only=True)
class CollisionReport:
    """The result of checking the whole remaining trajectory for collisions with the map."""

    stamp_s: float
    collision: bool
    time_to_collision_s: float  # inf if the trajectory is free
    future_collision_seq: int  # number of collisions predicted so far


WAYPOINT_FIELDS = ("x", "y", "z", "yaw", "vx", "vy", "vz", "ax", "ay", "az")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """A path of waypoints, each with a duration. Durations may be equal or unequal."""

    stamp_s: float  # start of the first waypoint
    waypoints: FloatArray  # (n, 10) in the order of WAYPOINT_FIELDS; m, rad, m/s, m/s^2, ENU
    durations_s: FloatArray  # (n,) duration of each waypoint
    trajectory_seq: int
    future_collision_seq: int  # number of the newest predicted collision when it was planned

    @property
    def duration_s(self) -> float:
        """The time, in seconds, from the start of the first waypoint to the end of the last."""
        return float(self.durations_s.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """One command from the control stage to the autopilot: velocity, yaw and acceleration."""

    stamp_s: float
    velocity_enu_mps: FloatArray  # (3,)
    yaw_rad: float
    acceleration_enu_mps2: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,)
    pace: float = 1.0  # rate of the trajectory's clock during this command, 0..1
    skips_waypoint: bool = False  # True ends the current waypoint


@dataclass(frozen=True, slots=True, kw_only=True)
class Invocation:
    """One invocation of a node in the timetable of a flight, with its simulated start and end."""

    node: str
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reaction:
    """A depth frame and the first setpoint that depends on it, given by their stamps."""

    frame_stamp_s: float
    setpoint_stamp_s: float


_COMPANION = "companion:"  # prefix of a companion's name in a mark


@dataclass(frozen=True, slots=True, kw_only=True)
class StackMark:
    """The identity of a stack, or of a user's companion, to which a detector model belongs.

    A model belongs to one stack, because error-free flights differ between stacks.

    Attributes:
        digest: SHA-256 of the settings of the stack. Equal digests mean equal stacks.
    """

    name: str
    digest: str

    @classmethod
    def of_companion(cls, name: str, digest: str) -> StackMark:
        """Make the mark of a user's companion, whose name no stack can have."""
        return cls(name=f"{_COMPANION}{name}", digest=digest)

    @property
    def is_companion(self) -> bool:
        """True if the mark is that of a user's companion."""
        return self.name.startswith(_COMPANION)


Message = CollisionReport | Trajectory | Command
Scalar = float | int | bool
_STAGES: dict[type[Message], Stage] = {
    CollisionReport: Stage.PERCEPTION, Trajectory: Stage.PLANNING, Command: Stage.CONTROL,
}  # fmt: skip


class DType(Enum):
    """The storage type of a state, or of a field of a MAVLink message, whose bits a fault flips."""

    FLOAT64 = "float64"
    INT32 = "int32"
    BOOL = "bool"
    FLOAT32 = "float32"
    INT8 = "int8"
    INT16 = "int16"
    INT64 = "int64"
    UINT8 = "uint8"
    UINT16 = "uint16"
    UINT32 = "uint32"
    UINT64 = "uint64"


@dataclass(frozen=True, slots=True)
class State:
    """A monitored state: a scalar in a message between kernels, and a site to inject faults."""

    name: str
    message: type[Message]
    source: str  # field of the message: a scalar, or an array with a row per waypoint or axis
    unit: str = "1"
    _: KW_ONLY
    column: int | None = None  # index in a waypoint or vector
    dtype: DType = DType.FLOAT64
    group: str = ""  # states that the paper corrupts together, e.g. components of a velocity
    detected: bool = False  # True for the 13 inputs of the autoencoder

    def __post_init__(self) -> None:
        object.__setattr__(self, "group", self.group or self.name)

    @property
    def stage(self) -> Stage:
        """Stage that outputs the state."""
        return _STAGES[self.message]

    def read(self, message: Message, index: int) -> Scalar:
        """Return the value of this state in a message.

        Args:
            index: Index of the waypoint; ignored for messages without waypoints.
        """
        value: Any = getattr(message, self.source)
        return float(value[self._place(index)]) if isinstance(value, np.ndarray) else value

    def write(self, message: Message, index: int, value: Scalar) -> Message:
        """Return a copy of a message in which this state has another value.

        Args:
            index: Index of the waypoint; ignored for messages without waypoints.
        """
        changed: Any = getattr(message, self.source)
        if isinstance(changed, np.ndarray):
            changed = changed.copy()
            changed[self._place(index)] = value
        else:
            changed = value
        return replace(message, **{self.source: changed})

    def _place(self, index: int) -> Any:
        if self.message is not Trajectory:
            return self.column
        return index if self.column is None else (index, self.column)


_KINDS = [("position", "m")] * 3 + [("yaw", "rad")]  # kind and unit of each waypoint column
_KINDS += [("velocity", "m/s")] * 3 + [("acceleration", "m/s^2")] * 3
STATES: tuple[State, ...] = (
    State("time_to_collision", CollisionReport, "time_to_collision_s", "s", detected=True),
    State("future_collision_seq", CollisionReport, "future_collision_seq", dtype=DType.INT32,
          detected=True),
    State("collision", CollisionReport, "collision", dtype=DType.BOOL),
    *(State(f"waypoint_{name}", Trajectory, "waypoints", _KINDS[column][1], column=column,
            group=f"waypoint_{_KINDS[column][0]}", detected=_KINDS[column][0] != "acceleration")
      for column, name in enumerate(WAYPOINT_FIELDS)),
    State("waypoint_duration", Trajectory, "durations_s", "s"),
    *(State(f"plan_{name}", Trajectory, name, dtype=DType.INT32)
      for name in ("trajectory_seq", "future_collision_seq")),
    *(State(f"command_v{axis}", Command, "velocity_enu_mps", "m/s", column=column,
            group="command_velocity", detected=True) for column, axis in enumerate("xyz")),
    State("command_yaw", Command, "yaw_rad", "rad", detected=True),
)  # fmt: skip
BY_NAME: dict[str, State] = {state.name: state for state in STATES}


@dataclass(slots=True)
class PilotCounters:
    """Counts of what the pilot did during a mission."""

    plans_requested: int = 0
    plans_failed: int = 0
    plans_ignored: int = 0  # stale, late, or out of order
    plans_rejected: int = 0  # withheld by the detector gate
    replans: int = 0  # plans adopted after the first
    collisions_foreseen: int = 0
    reports_ignored: int = 0  # stale future_collision_seq
    stops: int = 0
    slowdowns: int = 0
    look_rounds: int = 0
