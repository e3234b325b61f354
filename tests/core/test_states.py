import numpy as np
import pytest

from mavfi_cli.core.types import (
    BY_NAME,
    STATES,
    CollisionReport,
    Command,
    DType,
    Stage,
    Trajectory,
)

TRAJECTORY = Trajectory(
    stamp_s=1.0,
    waypoints=np.arange(30.0).reshape(3, 10),
    durations_s=np.array([0.5, 0.6, 0.7]),
    trajectory_seq=4,
    future_collision_seq=2,
)
MESSAGES = {
    Trajectory: TRAJECTORY,
    CollisionReport: CollisionReport(
        stamp_s=1.0, collision=True, time_to_collision_s=2.5, future_collision_seq=3
    ),
    Command: Command(stamp_s=1.0, velocity_enu_mps=np.array([1.0, 2.0, 3.0]), yaw_rad=0.5),
}
OTHER = {DType.FLOAT64: -77.25, DType.INT32: -12, DType.BOOL: False}


@pytest.mark.parametrize("state", STATES, ids=lambda s: s.name)
def test_what_is_written_is_read_and_nothing_else_changes(state):
    message = MESSAGES[state.message]
    before = {s.name: s.read(message, 1) for s in STATES if s.message is state.message}
    changed = state.write(message, 1, OTHER[state.dtype])
    after = {s.name: s.read(changed, 1) for s in STATES if s.message is state.message}
    assert after == before | {state.name: OTHER[state.dtype]}
    assert {s.name: s.read(message, 1) for s in STATES if s.message is state.message} == before
    others = {s.name: s.read(changed, 2) for s in STATES if s.message is Trajectory} if (
        state.message is Trajectory and state.name.startswith("waypoint")
    ) else {}  # fmt: skip
    assert others == {k: BY_NAME[k].read(message, 2) for k in others}


def test_the_thirteen_inputs_of_the_autoencoder():
    """Design: ttc, seq, waypoint x y z yaw vx vy vz, command vx vy vz yaw."""
    assert [s.name for s in STATES if s.detected] == [
        "time_to_collision", "future_collision_seq",
        "waypoint_x", "waypoint_y", "waypoint_z", "waypoint_yaw",
        "waypoint_vx", "waypoint_vy", "waypoint_vz",
        "command_vx", "command_vy", "command_vz", "command_yaw",
    ]  # fmt: skip


def test_every_stage_has_states():
    assert sum(len(stage.states) for stage in Stage) == len(STATES)
    assert all(stage.states for stage in Stage)
