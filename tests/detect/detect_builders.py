"""Messages and flights for the tests of detection."""

import numpy as np

from mavfi_cli.core.types import CollisionReport, Command, StackMark, Trajectory
from mavfi_cli.detect.preprocess import NAMES

STACK = StackMark(name="some", digest="5" * 64)
RANGES = {"collision": (-1, 1), "plan_trajectory_seq": (0, 1), "plan_future_collision_seq": (0, 2)}


def report(time_s=np.inf, seq=0):
    return CollisionReport(
        stamp_s=0.0, collision=np.isfinite(time_s), time_to_collision_s=time_s,
        future_collision_seq=seq,
    )  # fmt: skip


def command(vx=2.0, vy=1.0, vz=0.0, yaw=0.5):
    return Command(stamp_s=0.0, velocity_enu_mps=np.array([vx, vy, vz]), yaw_rad=yaw)


def plan(rows=20, speed=2.4):
    waypoints = np.zeros((rows, 10))
    waypoints[:, 0] = 4.0 + 0.5 * speed * np.arange(rows)
    waypoints[:, 2] = 5.0
    waypoints[:, 3] = 0.6
    waypoints[:, 4] = speed
    return Trajectory(
        stamp_s=0.0, waypoints=waypoints, durations_s=np.full(rows, 0.5), trajectory_seq=1,
        future_collision_seq=0,
    )  # fmt: skip


def trace(seconds=10.0, seed=0):
    """Columns as a mission writes them: a straight flight, its velocity a little uneven."""
    rng = np.random.default_rng(seed)
    rows = round(seconds * 50)
    t = np.arange(rows) * 0.02
    flown = plan(rows // 25 + 1)
    index = np.arange(rows) // 25
    columns = {"stamp_s": t, "waypoint_index": index.astype(np.float64)}
    for column, name in enumerate(NAMES[2:9]):
        columns[name] = flown.waypoints[index, column].copy()
    for column, name in enumerate(("waypoint_ax", "waypoint_ay", "waypoint_az")):
        columns[name] = flown.waypoints[index, 7 + column].copy()
    columns["time_to_collision"] = np.where(np.arange(rows) // 15 % 5 == 4, 3.0, np.inf)
    columns["report_stamp_s"] = (np.arange(rows) // 15 * 0.3).astype(np.float64)
    columns["future_collision_seq"] = (np.arange(rows) // 75).astype(np.float64)
    sway = 0.3 * np.sin(0.7 * t + rng.uniform(0, 6))
    columns["command_vx"], columns["command_vy"] = 2.4 + 0.1 * sway, sway
    columns["command_vz"], columns["command_yaw"] = 0.05 * sway, 0.6 + 0.1 * sway
    return columns
