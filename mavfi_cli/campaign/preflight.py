"""What the simulated vehicle says to a mission, before a thousand like it are begun."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.vehicle_process import VehicleProcess

START_S = 300.0  # the first start after an installation compiles, on a busy machine for minutes


def ask_vehicle(config: MissionConfig) -> None:
    """Start the vehicle of a mission, and end it at once.

    Raises:
        VehicleProcessError: it refuses the world, the vehicle, the start or the goal.
    """
    with tempfile.TemporaryDirectory(prefix="mavfi-") as folder:
        process = VehicleProcess(config, Path(folder))
        try:
            os.close(process.detach())
            process.stop(START_S)
            failure = process.failure()
        finally:
            process.close()
    if failure is not None:
        raise failure
