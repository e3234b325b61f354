"""Measures what detectors cost: the gate alone in a loop, and the gate in flights.

    python benchmarks/detector_cost.py [--flights 7] [--fault-seed 12]

In flights the caches hold other data, so a check costs several times more. The flights are in
`dense`, seed 3, on the stack `hardened`. They are golden, or have a flip in an exponent of a
planned waypoint, after which stages are recomputed. Shares are of the flight time, as in the
paper's Table V: for detection the host time of all checks, including those of plans, and for
recovery the simulated latencies of the recomputed stages.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from time import perf_counter_ns

import numpy as np
from missions import fly

from mavfi_cli.core.types import CollisionReport, Command, Trajectory
from mavfi_cli.detect import base
from mavfi_cli.detect.gate import Gate
from mavfi_cli.mission.measures import DetectionCost
from mavfi_cli.spec.detector import DetectorConfig

CALM = ("--stack", "hardened", "--world", "dense")
TICK_S = 0.02
REPORT_EVERY = 15  # ticks
WAYPOINT_TICKS = 25


def in_loop() -> None:
    """Time the gate in a loop over a minute of flight, and print the best of several rounds."""
    ticks = 3000
    angles = np.arange(ticks) * 0.004
    waypoints = np.zeros((ticks // WAYPOINT_TICKS + 1, 10))
    waypoints[:, 0] = np.arange(len(waypoints)) * 1.2
    waypoints[:, 4] = 2.4
    trajectory = Trajectory(
        stamp_s=0.0,
        waypoints=waypoints,
        durations_s=np.full(len(waypoints), 0.5),
        trajectory_seq=1,
        future_collision_seq=0,
    )
    commands = [
        Command(
            stamp_s=i * TICK_S,
            yaw_rad=0.5 * np.sin(a),
            velocity_enu_mps=np.array([2.0 + 0.4 * np.sin(a), np.sin(a), 0.05]),
        )
        for i, a in enumerate(angles.tolist())
    ]
    report = CollisionReport(stamp_s=0.0, collision=False, time_to_collision_s=np.inf,
                             future_collision_seq=1)  # fmt: skip

    def loop(judge: Callable[[Trajectory, int, Command], object]) -> float:
        """Return the mean time to judge one tick of the whole flight, in nanoseconds."""
        begun = perf_counter_ns()
        for i, command in enumerate(commands):
            judge(trajectory, i // WAYPOINT_TICKS, command)
        return (perf_counter_ns() - begun) / ticks

    def timed(name: str) -> float:
        """Return the mean time in which a detector's new gate judges a tick, in nanoseconds.

        Another gate of the detector first checks that the flight raises no alarm.
        """
        first, gate = (Gate(DetectorConfig(name=name).build("hardened")) for _ in range(2))
        assert not any(first.judge_tick(trajectory, i // WAYPOINT_TICKS, c) for i, c in
                       enumerate(commands)), "this flight is error-free"  # fmt: skip
        return loop(gate.judge_tick)

    empty = min(loop(lambda *_: None) for _ in range(7))
    print(f"{'detector':10} {'a check, us':>12} {'with waypoint':>15} {'share of 50 Hz':>15}"
          f" {'a report, us':>13}")  # fmt: skip
    for name in base.PLUG_INS.names:
        gate = Gate(DetectorConfig(name=name).build("hardened"))
        each = min(timed(name) for _ in range(7)) - empty
        fresh = []
        for i in range(100):
            begun = perf_counter_ns()
            gate.judge_tick(trajectory, 100 - i, commands[-1])
            fresh.append(perf_counter_ns() - begun)
        begun = perf_counter_ns()
        for _ in range(ticks):
            gate.judge_report(report)
        a_report = (perf_counter_ns() - begun) / ticks
        print(f"{name:10} {each / 1e3:12.2f} {np.median(fresh) / 1e3:15.2f}"
              f" {each / (TICK_S * 1e9):15.4%} {a_report / 1e3:13.2f}")  # fmt: skip
    print(
        f"\nA check is one control tick through Gate.judge_tick, a new waypoint every "
        f'{WAYPOINT_TICKS}th; "with waypoint" has one\neach time (median). Reports come every '
        f"{REPORT_EVERY} ticks. The loop itself, {empty / 1e3:.2f} us, is taken off."
    )


def in_flights(flights: int, fault_seed: int) -> None:
    """Time the gate in whole missions, and print medians over the flights."""
    fault = ("--inject", "planning", "--field", "exponent", "--fault-seed", str(fault_seed))
    print(f"\n{'detector':10} {'flight':8} {'checks/s':>9} {'a check, us':>12} {'detection':>10}"
          f" {'recovery':>9} {'alarms':>7}")  # fmt: skip
    for name in base.PLUG_INS.names:
        for kind, options in (("golden", ()), ("faulty", fault)):
            flown = [fly(*CALM, "--detector", name, *options).record
                     for _ in range(flights)]  # fmt: skip
            costs = [cost for cost in map(DetectionCost.of, flown) if cost is not None]
            check_us = 1e6 * statistics.median(cost.check_host_s for cost in costs)
            share = statistics.median(cost.detection_share for cost in costs)
            print(f"{name:10} {kind:8} {costs[-1].checks / costs[-1].flight_s:9.1f}"
                  f" {check_us:12.2f} {share:10.4%} {costs[-1].recovery_share:9.4%}"
                  f" {flown[-1]['detection']['alarm_count']:7d}")  # fmt: skip


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--flights", type=int, default=7)
    parser.add_argument("--fault-seed", type=int, default=12)
    given = parser.parse_args()
    in_loop()
    in_flights(given.flights, given.fault_seed)


if __name__ == "__main__":
    main()
