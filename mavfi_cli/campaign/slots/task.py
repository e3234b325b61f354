"""What a campaign's process does for one mission: fly it, and leave its run folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mavfi_cli.campaign.slots.desk import Desk
    from mavfi_cli.mission.vehicle_template import VehicleTemplate


def prepare() -> None:
    """Import and load all that a mission needs; every mission is a fork of this state."""
    import pyarrow.parquet  # noqa: F401  # only imported: its threads start at the first use

    import mavfi_cli.mission.run
    from mavfi_cli.autonomy import warm_up

    assert mavfi_cli.mission.run
    warm_up()


def equip() -> VehicleTemplate:
    """What forks the simulated vehicles of a slot.

    Raises:
        VehicleProcessError: it cannot be started.
    """
    from mavfi_cli.mission.vehicle_template import VehicleTemplate

    return VehicleTemplate()


def perform(changes: Mapping[str, Any], out: Path, vehicles: VehicleTemplate | None) -> Path:
    """Fly one mission; its run folder.

    Args:
        changes: of the mission, by `missions.changes_of`.
        out: where the run folder goes.
        vehicles: forks the simulated vehicle; None: it is started as a program.

    Raises:
        MavfiError: the mission could not begin, or its record could not be written.
    """
    from mavfi_cli.campaign.missions import config_from
    from mavfi_cli.mission.progress import Watcher
    from mavfi_cli.mission.run import fly_mission

    return fly_mission(config_from(changes), out, Watcher(), vehicles=vehicles).path


def perform_together(desk: Desk, vehicles: VehicleTemplate | None) -> Path:
    """Fly missions that begin alike; the run folder of the one that this process has become.

    Raises:
        MavfiError: as `perform`.
    """
    from mavfi_cli.campaign.slots.cast import Cast
    from mavfi_cli.mission.run import fly_together

    assert vehicles is not None
    return fly_together(Cast(desk), desk.place, vehicles).path
