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


def _field(name: str) -> tuple[Callable[..., Scalar], Callable[..., Message]]:
    def read(message: Message, _index: int) -> Scalar:
        """Return the field's value."""
        value: Scalar = getattr(message, name)
        return value

    def write(message: Message, _index: int, value: Scalar) -> Message:
        """Return a copy of the message with another value."""
        return replace(message, **{name: value})  # type: ignore[arg-type]

    return read, write


def _element(
    array: str, column: int | None
) -> tuple[Callable[..., Scalar], Callable[..., Message]]:
    """Return reader and writer of row `index` of an array or of one of its columns."""

    def place(index: int) -> int | tuple[int, int]:
        return index if column is None else (index, column)

    def read(message: Message, index: int) -> Scalar:
        """Return the element's value."""
        return float(getattr(message, array)[place(index)])

    def write(message: Message, index: int, value: Scalar) -> Message:
        """Return a copy of the message, and of its array, with another value."""
        changed = np.array(getattr(message, array))
        changed[place(index)] = value
        return replace(message, **{array: changed})  # type: ignore[arg-type]

    return read, write


def _component(array: str, column: int) -> tuple[Callable[..., Scalar], Callable[..., Message]]:
    """Return reader and writer of one component of a vector."""
    read, write = _element(array, None)
    return (
        lambda message, _index: read(message, column),
        lambda message, _index, value: write(message, column, value),
    )


def _perception() -> list[State]:
    kind = {"stage": Stage.PERCEPTION, "message": CollisionReport}
    rows = [
        ("time_to_collision", "time_to_collision_s", DType.FLOAT64, "s", True),
        ("future_collision_seq", "future_collision_seq", DType.INT32, "1", True),
        ("collision", "collision", DType.BOOL, "1", False),
    ]
    table = []
    for name, attribute, dtype, unit, detected in rows:
        read, write = _field(attribute)
        table.append(
            State(name=name, group=name, dtype=dtype, unit=unit, read=read, write=write,
                  detected=detected, **kind)  # type: ignore[arg-type]
        )  # fmt: skip
    return table


_WAYPOINT_UNITS = {"position": "m", "yaw": "rad", "velocity": "m/s", "acceleration": "m/s^2"}


def _waypoint_group(name: str) -> str:
    if name == "yaw":
        return "yaw"
    return {"v": "velocity", "a": "acceleration"}.get(name[0], "position")


def _planning() -> list[State]:
    table = []
    for column, name in enumerate(WAYPOINT_FIELDS):
        read, write = _element("waypoints", column)
        group = _waypoint_group(name)
        table.append(
            State(name=f"waypoint_{name}", stage=Stage.PLANNING, dtype=DType.FLOAT64,
                  unit=_WAYPOINT_UNITS[group], group=f"waypoint_{group}", message=Trajectory,
                  read=read, write=write, detected=group != "acceleration")
        )  # fmt: skip
    read, write = _element("durations_s", None)
    table.append(
        State(name="waypoint_duration", stage=Stage.PLANNING, dtype=DType.FLOAT64, unit="s",
              group="waypoint_duration", message=Trajectory, read=read, write=write)
    )  # fmt: skip
    for name in ("trajectory_seq", "future_collision_seq"):
        read, write = _field(name)
        table.append(
            State(name=f"plan_{name}", stage=Stage.PLANNING, dtype=DType.INT32, unit="1",
                  group=f"plan_{name}", message=Trajectory, read=read, write=write)
        )  # fmt: skip
    return table


def _control() -> list[State]:
    table = []
    for column, axis in enumerate("xyz"):
        read, write = _component("velocity_enu_mps", column)
        table.append(
            State(name=f"command_v{axis}", stage=Stage.CONTROL, dtype=DType.FLOAT64, unit="m/s",
                  group="command_velocity", message=Command, read=read, write=write, detected=True)
        )  # fmt: skip
    read, write = _field("yaw_rad")
    table.append(
        State(name="command_yaw", stage=Stage.CONTROL, dtype=DType.FLOAT64, unit="rad",
              group="command_yaw", message=Command, read=read, write=write, detected=True)
    )  # fmt: skip
    return table


STATES: tuple[State, ...] = (*_perception(), *_planning(), *_control())
BY_NAME: dict[str, State] = {state.name: state for state in STATES}


def of_stage(stage: Stage) -> tuple[State, ...]:
    """Return the states that a stage outputs, in table order."""
    return tuple(state for state in STATES if state.stage is stage)
