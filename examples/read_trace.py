"""Read the trace of a run: one row per control tick of 20 ms."""

import sys

import numpy as np

import mavfi_cli as mavfi

if len(sys.argv) > 1:
    run = mavfi.load_run(sys.argv[1])
else:
    run = mavfi.fly(world="farm", seed=5, start=(2, 2, 0), goal=(10, 6, 5))
stamp_s = run.trace["stamp_s"].to_numpy()
place_m = np.column_stack([run.trace[f"truth_{axis}_m"].to_numpy() for axis in "xyz"])  # (N, 3)
speed_mps = np.linalg.norm(np.diff(place_m, axis=0), axis=1) / np.diff(stamp_s)
print(f"{len(stamp_s)} ticks, top speed {speed_mps.max():.2f} m/s")
