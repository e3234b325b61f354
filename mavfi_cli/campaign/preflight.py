"""Asks the simulated vehicle whether it accepts a mission before a thousand like it begin."""

from __future__ import annotations

import tempfile
from pathlib import Path

from mavfi_cli.core.errors import MavfiError, VehicleProcessError
from mavfi_cli.mission.vehicle import VehicleInProcess
from mavfi_cli.spec.mission import MissionConfig


def ask_vehicle(config: MissionConfig) -> None:
    """Start the vehicle of a mission and end it at once.

    Raises:
        VehicleProcessError: it refuses the world, the vehicle, the start or the goal.
    """
    with tempfile.TemporaryDirectory(prefix="mavfi-") as folder:
        try:
            VehicleInProcess(config, Path(folder)).end()
        except MavfiError as error:
            raise VehicleProcessError(str(error)) from None
