"""The briefing of a companion that starts together with the vehicle."""

from __future__ import annotations

from pathlib import Path

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_json
from sitl.server.simulation import Simulation

FILE = "briefing.json"


def write_briefing(simulation: Simulation, folder: Path) -> None:
    """Write goal, bounds and camera mounting to `folder`, before the first message is sent.

    Raises:
        RecordError: the file cannot be written.
    """
    world = simulation.referee.world
    briefing = {
        "start_enu_m": world.start_enu_m.tolist(),
        "goal_enu_m": world.goal_enu_m.tolist(),
        "bounds_enu_m": world.bounds_enu_m.tolist(),
        "camera_offset_flu_m": [float(c) for c in simulation.camera.optics.mount_offset_flu_m],
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror or error}") from None
    write_json(folder / FILE, briefing)
