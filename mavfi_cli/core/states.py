"""The table of monitored states, which fi, detect and report iterate over.

A state is a scalar, or one component of a vector, that one kernel passes to the next. All reads
and writes of a state go through this table, so that no other module knows its place.
Source of the list: paper, section IV-C and V-A; reference facts, sections 1.3 and 1.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from mavfi_cli.core.types import WAYPOINT_FIELDS, CollisionReport, Command, Stage, Trajectory

Message = CollisionReport | Trajectory | Command
Scalar = float | int | bool


class DType(Enum):
    """Storage type of a state, whose bits a fault flips."""

    FLOAT64 = "float64"
    INT32 = "int32"
    BOOL = "bool"


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """A monitored inter-kernel state and injection site."""

    name: str
    stage: Stage
    dtype: DType
    unit: str
    group: str  # states that the paper corrupts together, e.g. components of a velocity
    message: type[Message]
    read: Callable[[Message, int], Scalar]  # (message, waypoint index)
    write: Callable[[Message, int, Scalar], Message]  # returns a changed copy
    detected: bool = False  # True for the 13 inputs of the autoencoder


_Access = tuple[Callable[..., Scalar], Callable[..., Message]]


def _field(name: str) -> _Access:
    """Return reader and writer of a field."""
    return (
        lambda message, _index: getattr(message, name),
        lambda message, _index, value: replace(message, **{name: value}),
    )


def _element(array: str, column: int | None = None) -> _Access:
    """Return reader and writer of row `index` of an array, or of one of its columns."""

    def place(index: int) -> int | tuple[int, int]:
        return index if column is None else (index, column)

    def write(message: Message, index: int, value: Scalar) -> Message:
        changed = np.array(getattr(message, array))
        changed[place(index)] = value
        return replace(message, **{array: changed})  # type: ignore[arg-type]

    return lambda message, index: float(getattr(message, array)[place(index)]), write


def _component(array: str, column: int) -> _Access:
    """Return reader and writer of one component of a vector."""
    read, write = _element(array)
    return (
        lambda message, _index: read(message, column),
        lambda message, _index, value: write(message, column, value),
    )


_STAGES = {
    CollisionReport: Stage.PERCEPTION, Trajectory: Stage.PLANNING, Command: Stage.CONTROL,
}  # fmt: skip


def _state(
    message: type[Message],
    name: str,
    access: _Access,
    unit: str = "1",
    *,
    dtype: DType = DType.FLOAT64,
    group: str = "",
    detected: bool = False,
) -> State:
    read, write = access
    return State(
        name=name, stage=_STAGES[message], dtype=dtype, unit=unit, group=group or name,
        message=message, read=read, write=write, detected=detected,
    )  # fmt: skip


def _waypoint(column: int, name: str) -> State:
    kind = {"y": "yaw", "v": "velocity", "a": "acceleration"}.get(name[0] if name != "y" else "")
    group, unit = kind or "position", _UNITS[kind or "position"]
    return _state(Trajectory, f"waypoint_{name}", _element("waypoints", column), unit,
                  group=f"waypoint_{group}", detected=group != "acceleration")  # fmt: skip


_UNITS = {"position": "m", "yaw": "rad", "velocity": "m/s", "acceleration": "m/s^2"}

STATES: tuple[State, ...] = (
    _state(CollisionReport, "time_to_collision", _field("time_to_collision_s"), "s", detected=True),
    _state(CollisionReport, "future_collision_seq", _field("future_collision_seq"),
           dtype=DType.INT32, detected=True),
    _state(CollisionReport, "collision", _field("collision"), dtype=DType.BOOL),
    *(_waypoint(column, name) for column, name in enumerate(WAYPOINT_FIELDS)),
    _state(Trajectory, "waypoint_duration", _element("durations_s"), "s"),
    *(_state(Trajectory, f"plan_{name}", _field(name), dtype=DType.INT32)
      for name in ("trajectory_seq", "future_collision_seq")),
    *(_state(Command, f"command_v{axis}", _component("velocity_enu_mps", column), "m/s",
             group="command_velocity", detected=True) for column, axis in enumerate("xyz")),
    _state(Command, "command_yaw", _field("yaw_rad"), "rad", detected=True),
)  # fmt: skip
BY_NAME: dict[str, State] = {state.name: state for state in STATES}


def of_stage(stage: Stage) -> tuple[State, ...]:
    """Return the states that a stage outputs, in table order."""
    return tuple(state for state in STATES if state.stage is stage)
