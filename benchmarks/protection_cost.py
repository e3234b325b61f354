"""Measures what each protection costs in flights without a fault.

    python benchmarks/protection_cost.py --seeds 3

Flies golden flights of `mavbench-replica` in the fixed worlds with each protection. For each it
prints means over the seeds: the compute time of all kernels on the simulated computer, and its
ratio to that without a protection; the checks of the detector (host time) and its recomputations,
as shares of the flight time; the flight time; and the alarms of all flights. A hot standby repeats
the work of its process, OctoMap, check and planner, which the record does not count, so it is added
here. Everything but the time of the checks repeats to the digit.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from statistics import fmean

import mavfi_cli as mavfi
from mavfi_cli.mission.measures import DetectionCost, FlightRecord

WORLDS = {"factory": 2, "sparse": 4, "dense": 10}
STACK, STANDBY = "mavbench-replica", ':standby=["planner"]'
OF_THE_STANDBY = ("octomap", "collision_check", "planner")
ARMS = {
    "none": ("", None, "paper"),
    "GAD": ("", "gad", "paper"),
    "GAD, extended watch": ("", "gad", "extended"),
    "AAD": ("", "aad", "paper"),
    "AAD, extended watch": ("", "aad", "extended"),
    "supervisor": (":restores_counters=true", None, "paper"),
    "supervisor, a process for each node": (":processes=[],restores_counters=true", None, "paper"),
    "hot standby of the planner": (STANDBY, None, "paper"),
}


def main() -> None:
    """Fly every protection in every world, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=3)
    seeds = parser.parse_args().seeds
    print("| world | protection | compute time, s | ratio | checks, % | recomputations, % "
          "| flight time, s | alarms |\n|---|---|---|---|---|---|---|---|")  # fmt: skip
    for world in WORLDS:
        usual_s = 0.0
        for name, (changes, detector, watch) in ARMS.items():
            flown = [_fly(world, seed, changes, detector, watch) for seed in range(1, seeds + 1)]
            busy_s = fmean(_busy_s(record, standby=changes == STANDBY) for record in flown)
            usual_s = usual_s or busy_s
            costs = [cost for record in flown if (cost := DetectionCost.of(record)) is not None]
            checks, again = (
                f"{100.0 * fmean(shares):.3f}" if shares else ""
                for shares in ([cost.detection_share for cost in costs],
                               [cost.recovery_share for cost in costs])
            )  # fmt: skip
            time_s = fmean(record.quality_of_flight.flight_time_s or 0.0 for record in flown)
            told = [own.alarm_count or 0 for record in flown if (own := record.detection)]
            alarms = str(sum(told)) if told else ""
            cells = [world, name, f"{busy_s:.1f}", f"{busy_s / usual_s:.2f}", checks, again,
                     f"{time_s:.1f}", alarms]  # fmt: skip
            print(f"| {' | '.join(cells)} |", flush=True)


def _fly(
    world: str, seed: int, changes: str, detector: str | None, watch: str
) -> FlightRecord:  # fmt: skip
    own = None if detector is None else mavfi.DetectorConfig(name=detector, watch=watch)
    with tempfile.TemporaryDirectory() as folder:
        return mavfi.fly(
            stack=STACK + changes, world=world, seed=seed, world_seed=WORLDS[world], detector=own,
            out=Path(folder),
        ).record  # fmt: skip


def _busy_s(record: FlightRecord, *, standby: bool) -> float:
    twice = OF_THE_STANDBY if standby else ()
    return sum(own.busy_s * (1 + (name in twice)) for name, own in record.kernels.items())


if __name__ == "__main__":
    main()
