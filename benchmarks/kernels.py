"""What each kernel of the autonomy costs, in CPU milliseconds a call, in a dense world.

    python benchmarks/kernels.py [--seed 10]

A vehicle that follows its trajectories perfectly flies the mission; every kernel is called as
often as a flight calls it (perception 3.5 times a simulated second, control 50 times).
"""

from __future__ import annotations

import argparse
import math
import time
from collections import defaultdict

import numpy as np

from mavfi_cli import autonomy
from mavfi_cli.autonomy import collision, planners, planning, point_cloud, tracking
from mavfi_cli.autonomy.occupancy import OccupancyMap, OccupancyParams
from mavfi_cli.autonomy.smoothing import Departure, Sequence
from mavfi_cli.autonomy.trajectory import reference_waypoint
from mavfi_cli.core.frames import quaternion_from_euler
from mavfi_cli.core.types import DepthFrame
from sitl.camera.depth import render_depth
from sitl.world import load_world

TICK_S = 0.02
TICKS_A_FRAME = 14
LEAD_S = 0.26


class Stopwatch:
    """CPU time by name."""

    def __init__(self) -> None:
        self.spent_s: dict[str, list[float]] = defaultdict(list)

    def call(self, name, function, *arguments):
        """Call and note the time."""
        begin = time.process_time()
        result = function(*arguments)
        self.spent_s[name].append(time.process_time() - begin)
        return result


def fly(world, seed: int, watch: Stopwatch) -> float:
    """Fly one mission; returns its simulated duration."""
    bounds = world.bounds_enu_m.copy()
    bounds[2], bounds[5] = 1.0, min(bounds[5], 10.0)
    position, yaw = world.start_enu_m + np.array([0.0, 0.0, 5.0]), math.atan2(40.0, 30.0)
    occupancy, planner = OccupancyMap(OccupancyParams()), planners.find("rrtstar")
    check_state = collision.CollisionState()
    track_state = tracking.TrackingState(yaw_rad=yaw, stamp_s=0.0)
    trajectory = following = None
    plans = 0
    for tick in range(10_000):
        now_s = tick * TICK_S
        if tick % TICKS_A_FRAME == 0:
            attitude = quaternion_from_euler(0.0, 0.0, yaw)
            levels = render_depth(world.boxes_enu_m, position, attitude, 64, 48, math.pi / 2)
            frame = DepthFrame(
                stamp_s=now_s,
                depth_m=np.where(levels == 255, np.inf, levels * 0.1),
                hfov_rad=math.pi / 2,
                position_enu_m=position,
                quaternion=attitude,
            )
            cloud = watch.call(
                "point cloud", point_cloud.generate, frame, point_cloud.PointCloudParams()
            )
            watch.call("octomap insert", occupancy.insert, cloud)
            snapshot = watch.call("octomap snapshot", occupancy.snapshot)
            time_s = now_s - trajectory.stamp_s if trajectory else 0.0
            check_state, report = watch.call(
                "collision check",
                collision.step,
                check_state,
                collision.CollisionInputs(
                    stamp_s=now_s, snapshot=snapshot, trajectory=trajectory, time_s=time_s
                ),
                collision.CollisionParams(),
            )
            if following is None and (trajectory is None or report.collision):
                start, velocity = position, np.zeros(3)
                if trajectory is not None:
                    row = reference_waypoint(trajectory, time_s + LEAD_S)
                    start, velocity = row[0:3], row[4:7]
                plans += 1
                planned = watch.call(
                    "planner + smoothing",
                    planning.plan,
                    planner,
                    planning.StageInputs(
                        snapshot=snapshot,
                        position_enu_m=start,
                        departure=Departure(
                            stamp_s=now_s + LEAD_S, velocity_enu_mps=velocity, yaw_rad=yaw
                        ),
                        goal_enu_m=world.goal_enu_m,
                        bounds_enu_m=bounds,
                        sequence=Sequence(trajectory_seq=plans),
                        seed=1000 * seed + plans,
                    ),
                    planning.StageParams(),
                )
                following = planned.trajectory
        if following is not None and now_s >= following.stamp_s:
            trajectory, following = following, None
        time_s = now_s - trajectory.stamp_s if trajectory else 0.0
        track_state, command = watch.call(
            "tracking",
            tracking.step,
            track_state,
            tracking.TrackingInputs(
                stamp_s=now_s,
                position_enu_m=position,
                velocity_enu_mps=np.zeros(3),
                trajectory=trajectory,
                time_s=time_s,
                hold_enu_m=position,
                hold_yaw_rad=yaw,
            ),
            tracking.TrackingParams(),
        )
        yaw = command.yaw_rad
        if trajectory is not None:
            position = reference_waypoint(trajectory, time_s)[0:3]
        if np.linalg.norm(position - world.goal_enu_m) < 1.0:
            break
    return now_s


def main() -> None:
    """Fly, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="dense")
    parser.add_argument("--seed", type=int, default=10)
    options = parser.parse_args()
    begin = time.perf_counter()
    autonomy.warm_up()
    print(f"warm-up {time.perf_counter() - begin:.2f} s")
    watch = Stopwatch()
    flown_s = fly(load_world(options.world, seed=options.seed), options.seed, watch)
    print(f"{options.world} {options.seed}: {flown_s:.1f} s flown")
    print(f"{'kernel':22}{'calls':>7}{'mean ms':>10}{'max ms':>9}{'ms / simulated s':>18}")
    total_ms = 0.0
    for name, spent_s in watch.spent_s.items():
        ms = 1e3 * np.array(spent_s)
        total_ms += ms.sum()
        print(f"{name:22}{len(ms):7}{ms.mean():10.3f}{ms.max():9.3f}{ms.sum() / flown_s:18.2f}")
    print(f"{'all':22}{'':26}{total_ms / flown_s:18.2f}")


if __name__ == "__main__":
    main()
