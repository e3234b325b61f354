"""Counts what bit flips in the detector itself do: one flip per flight, anywhere in its memory.

    python benchmarks/detector_faults.py --flights 50 --out detector-faults

Each flight is paired with a flight that has the same detector but no flip. All fly the stack
`hardened`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path

from mavfi_cli.analysis.pairs import LONGER
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import DETECTOR, FaultConfig
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.shares import wilson

FIRST_SEED = 600_000


def main() -> None:
    """Fly the missions, and print what the flips did."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--flights", type=int, default=50, help="of each world")
    parser.add_argument("--world", nargs="+", default=["sparse", "dense"])
    parser.add_argument("--detector", nargs="+", default=["gad", "aad"])
    parser.add_argument("--out", type=Path, default=Path("detector-faults"))
    parser.add_argument("--jobs", type=int, default=0)
    asked = parser.parse_args()
    missions = []
    for name in asked.detector:
        for world in asked.world:
            for number in range(asked.flights):
                calm = MissionConfig(
                    world=world,
                    seed=FIRST_SEED + number,
                    stack="hardened",
                    detector=DetectorConfig(name=name),
                )
                fault = FaultConfig(target=DETECTOR, seed=number + 1)
                for struck in (False, True):
                    config = replace(calm, fault=fault) if struck else calm
                    labels = {"detector": name, "world": world, "struck": struck}
                    missions.append(PlannedMission(config=config, labels=labels))
    options = Options(jobs=asked.jobs, keep=Keep.NONE)
    with run_campaign(missions, asked.out, options, Spectator()) as ledger:
        results = [entry.result for entry in ledger.results()]
    for name in asked.detector:
        counts: Counter[str] = Counter()
        for mission, calm_result, struck_result in zip(
            missions[::2], results[::2], results[1::2], strict=True
        ):
            if mission.labels["detector"] == name:
                counts.update(_what_happened(calm_result, struck_result))
        total = counts["flights"]
        print(f"{name}: {total} flights with a flip in the detector, 95 % Wilson intervals")
        for what in ("not injected", "no effect at all", "alarms", "lost", "longer by over 10 %"):
            share = wilson(counts[what], total)
            figures = f"{100 * share.share:5.1f} % ({100 * share.low:.1f}, {100 * share.high:.1f})"
            print(f"  {what:<20} {share.count:4d}  {figures}")


def _what_happened(calm: dict, struck: dict) -> list[str]:
    """Return the categories to count for a flight with a flip, compared with the one without."""
    found = ["flights"]
    if struck["fault"]["state"] != "applied":
        return [*found, "not injected"]
    if struck["detection"]["alarm_count"] > calm["detection"]["alarm_count"]:
        found.append("alarms")
    times = [result["quality_of_flight"]["flight_time_s"] for result in (calm, struck)]
    if calm["outcome"] == "success" != struck["outcome"]:
        found.append("lost")
    elif calm["outcome"] == struck["outcome"] == "success" and times[1] > LONGER * times[0]:
        found.append("longer by over 10 %")
    if len(found) == 1:
        found.append("no effect at all")
    return found


if __name__ == "__main__":
    main()
