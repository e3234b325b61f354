"""Fly a small campaign and read its table."""

from pathlib import Path

import mavfi_cli as mavfi

PLACE = {"world": "farm", "start": (2.0, 2.0, 0.0), "goal": (10.0, 6.0, 5.0)}
FAULTS = {"golden": None, "planning": mavfi.FaultConfig(target="planning", field="exponent")}
missions = [
    mavfi.PlannedMission(
        config=mavfi.MissionConfig(seed=seed, fault=fault, **PLACE), labels={"fault": name}
    )
    for seed in (5, 6)
    for name, fault in FAULTS.items()
]
if __name__ == "__main__":  # the workers are processes of their own
    mavfi.run_campaign(missions, Path("campaigns/small")).close()
    table = mavfi.campaign("campaigns/small").table
    for row in table.select(["label_fault", "seed", "outcome", "flight_time_s"]).to_pylist():
        print(row)
