"""Fly a golden run: a mission without a fault."""

import mavfi_cli as mavfi

run = mavfi.fly(world="farm", seed=5, start=(2, 2, 0), goal=(10, 6, 5))
quality = run.result["quality_of_flight"]
print(run.result["outcome"], f"after {quality['flight_time_s']:.1f} s, in {run.folder.path}")
