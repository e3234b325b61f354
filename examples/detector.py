"""Fly the same fault with a detector that recomputes the corrupted plan."""

import mavfi_cli as mavfi

run = mavfi.fly(
    world="farm",
    seed=5,
    start=(2, 2, 0),
    goal=(10, 6, 5),
    fault={"target": "waypoint_y", "field": "exponent", "seed": 1},
    detector={"name": "gad"},
)
print(run.result["outcome"], "with", len(run.result["detection"]["alarms"]), "alarm")
