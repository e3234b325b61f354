"""The briefing of a mission: what its companion knows of world and camera before the flight."""

from __future__ import annotations

from pathlib import Path

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_json
from mavfi_cli.core.frames import Vector
from sitl.world import World


def write_briefing(world: World, camera_mount_flu_m: Vector, folder: Path) -> None:
    """Write start, goal, bounds and camera mounting (3,) to `folder`, before the first message.

    Raises:
        RecordError: The file cannot be written.
    """
    briefing = {
        "start_enu_m": world.start_enu_m.tolist(),
        "goal_enu_m": world.goal_enu_m.tolist(),
        "bounds_enu_m": world.bounds_enu_m.tolist(),
        "camera_offset_flu_m": camera_mount_flu_m.tolist(),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror or error}") from None
    write_json(folder / "briefing.json", briefing)
