"""Fly one fault on two stacks: the paper's, and one that checks the plan."""

import mavfi_cli as mavfi

for stack in ("mavbench", "hardened"):
    run = mavfi.fly(
        world="farm",
        seed=5,
        stack=stack,
        start=(2, 2, 0),
        goal=(10, 6, 5),
        time_limit_s=60,
        fault={"target": "waypoint_y", "field": "exponent", "seed": 1},
    )
    flown_m = run.result["quality_of_flight"]["distance_m"]
    print(f"{stack}: {run.result['outcome']}, {flown_m:.1f} m flown")
