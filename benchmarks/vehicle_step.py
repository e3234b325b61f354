"""Measures the time of one 4 ms step of the simulated vehicle, and where that time goes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from sitl.vehicle.cascade import SETPOINT_SIZE, control_step
from sitl.vehicle.profile import PROFILES, load_profile
from sitl.vehicle.vehicle import Quadrotor

STEPS = 500
ROUNDS = 20


def median_us(work: Callable[[], object]) -> float:
    """Return the mean time of one call in a round, in microseconds: the median over rounds."""
    rounds = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for _ in range(STEPS):
            work()
        rounds.append((time.perf_counter() - start) / STEPS * 1e6)
    return statistics.median(rounds)


def main() -> None:
    """Time every shipped vehicle profile in forward flight, and print the times."""
    setpoint = np.full(SETPOINT_SIZE, np.nan)
    setpoint[3:6], setpoint[9] = (1.0, 0.5, -0.2), 0.3
    for name in PROFILES.names:
        vehicle = Quadrotor(load_profile(name), position_enu_m=(0.0, 0.0, 5.0), yaw_enu_rad=0.0)
        for _ in range(STEPS):
            vehicle.step(setpoint, armed=True)
        whole = median_us(lambda vehicle=vehicle: vehicle.step(setpoint, armed=True))
        control = median_us(
            lambda v=vehicle: control_step(v._state, v._flat, setpoint, v._gains, True)  # noqa: FBT003
        )
        commands = vehicle.truth.motor_commands.copy()
        physics = median_us(lambda v=vehicle, c=commands: v._physics.advance(c))
        reading = median_us(lambda v=vehicle: v._physics.read(v._raw))
        print(
            f"{name}: step {whole:.1f} us; alone: JSBSim {physics:.1f}, reading {reading:.1f}, "
            f"controller {control:.1f}"
        )


if __name__ == "__main__":
    main()
