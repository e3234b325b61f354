"""Measures the CPU time per call of each kernel of the autonomy, in a dense world.

    python benchmarks/kernels.py [--seed 10]

A vehicle that follows its trajectories perfectly flies the mission. Every kernel is called as often
as in a real flight (per simulated second, perception 3.5 times and control 50 times).
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections import defaultdict

import numpy as np

from mavfi_cli.autonomy import collision, planners, point_cloud, tracking, warm
from mavfi_cli.autonomy.occupancy import MapSnapshot, OccupancyMap, OccupancyParams
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.autonomy.tracking import reference_waypoint
from mavfi_cli.core.frames import quaternion_from_euler
from mavfi_cli.core.types import DepthFrame, Trajectory
from sitl.camera.depth import render_depth
from sitl.world import World, load_world

TICK_S = 0.02
TICKS_A_FRAME = 14
LEAD_S = 0.26


class Stopwatch:
    """Records the CPU times of calls, keyed by name."""

    def __init__(self) -> None:
        self.spent_s: dict[str, list[float]] = defaultdict(list)

    def call(self, name, function, *arguments):
        """Call a function, record its CPU time under a name, and return its result."""
        begin = time.process_time()
        result = function(*arguments)
        self.spent_s[name].append(time.process_time() - begin)
        return result


class Flight:
    """One mission of a vehicle that is always exactly on its trajectory.

    Args:
        world: World with start, goal and boxes.
        seed: Seed of the planner.
        watch: Stopwatch that times every kernel.
    """

    def __init__(self, world: World, seed: int, watch: Stopwatch) -> None:
        self._world, self._seed, self._watch = world, seed, watch
        self._bounds = world.bounds_enu_m.copy()
        self._bounds[2], self._bounds[5] = 1.0, min(self._bounds[5], 10.0)
        self._position = world.start_enu_m + np.array([0.0, 0.0, 5.0])
        self._yaw = math.atan2(40.0, 30.0)
        self._map, self._planner = OccupancyMap(OccupancyParams()), planners.find("rrtstar")
        self._check_state = collision.CollisionState()
        self._track_state = tracking.TrackingState(yaw_rad=self._yaw, stamp_s=0.0)
        self._trajectory: Trajectory | None = None
        self._next: Trajectory | None = None
        self._plans = 0

    def fly(self) -> float:
        """Fly to the goal, and return the simulated duration in seconds."""
        for tick in range(10_000):
            now_s = tick * TICK_S
            if tick % TICKS_A_FRAME == 0:
                snapshot, blocked = self._perceive(now_s)
                if self._next is None and (self._trajectory is None or blocked):
                    self._plan(now_s, snapshot)
            if self._next is not None and now_s >= self._next.stamp_s:
                self._trajectory, self._next = self._next, None
            self._track(now_s)
            if np.linalg.norm(self._position - self._world.goal_enu_m) < 1.0:
                break
        return now_s

    def _flown_s(self, now_s: float) -> float:
        return now_s - self._trajectory.stamp_s if self._trajectory else 0.0

    def _perceive(self, now_s: float) -> tuple[MapSnapshot, bool]:
        """Add a depth frame to the map. Return the map, and whether it blocks the trajectory."""
        attitude = quaternion_from_euler(0.0, 0.0, self._yaw)
        boxes = self._world.boxes_enu_m
        levels = render_depth(boxes, self._position, attitude, 64, 48, math.pi / 2)
        frame = DepthFrame(
            stamp_s=now_s,
            depth_m=np.where(levels == 255, np.inf, levels * 0.1),
            hfov_rad=math.pi / 2,
            position_enu_m=self._position,
            quaternion=attitude,
        )
        call = self._watch.call
        cloud = call("point cloud", point_cloud.generate, frame, point_cloud.PointCloudParams())
        call("octomap insert", self._map.insert, cloud)
        snapshot = call("octomap snapshot", self._map.snapshot)
        inputs = collision.CollisionInputs(
            stamp_s=now_s,
            snapshot=snapshot,
            trajectory=self._trajectory,
            time_s=self._flown_s(now_s),
        )
        self._check_state, report = call(
            "collision check",
            collision.step,
            self._check_state,
            inputs,
            collision.CollisionParams(),
        )
        return snapshot, report.collision

    def _plan(self, now_s: float, snapshot: MapSnapshot) -> None:
        """Plan from the point where the vehicle will be when the plan takes effect."""
        start, velocity = self._position, np.zeros(3)
        if self._trajectory is not None:
            row = reference_waypoint(self._trajectory, self._flown_s(now_s) + LEAD_S)
            start, velocity = row[0:3], row[4:7]
        self._plans += 1
        request = PlanRequest(
            stamp_s=now_s + LEAD_S,
            position_enu_m=start,
            velocity_enu_mps=velocity,
            yaw_rad=self._yaw,
            goal_enu_m=self._world.goal_enu_m,
            attempt=self._plans,
            trajectory_seq=self._plans,
        )
        plan = functools.partial(
            planners.plan,
            bounds_enu_m=self._bounds,
            seed=1000 * self._seed + self._plans,
            params=planners.PlanningParams(),
        )
        found = self._watch.call("planner + smoothing", plan, self._planner, request, snapshot)
        self._next = found if isinstance(found, Trajectory) else None

    def _track(self, now_s: float) -> None:
        """Run one control tick, then move the vehicle to the trajectory's current point."""
        inputs = tracking.TrackingInputs(
            stamp_s=now_s,
            position_enu_m=self._position,
            velocity_enu_mps=np.zeros(3),
            trajectory=self._trajectory,
            time_s=self._flown_s(now_s),
            hold_enu_m=self._position,
            hold_yaw_rad=self._yaw,
        )
        self._track_state, command = self._watch.call(
            "tracking", tracking.step, self._track_state, inputs, tracking.TrackingParams()
        )
        self._yaw = command.yaw_rad
        if self._trajectory is not None:
            self._position = reference_waypoint(self._trajectory, self._flown_s(now_s))[0:3]


def main() -> None:
    """Fly the mission, and print the table of kernels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="dense")
    parser.add_argument("--seed", type=int, default=10)
    options = parser.parse_args()
    begin = time.perf_counter()
    warm.warm_up()
    print(f"warm-up {time.perf_counter() - begin:.2f} s")
    watch = Stopwatch()
    world = load_world(options.world, seed=options.seed)
    flown_s = Flight(world, options.seed, watch).fly()
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
