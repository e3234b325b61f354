"""The work of a campaign's worker: fly one mission and write its run folder."""

from __future__ import annotations

from pathlib import Path

from mavfi_cli.campaigns.missions import Changes


def prepare() -> None:
    """Import and load everything that a mission needs, before workers are forked."""
    import pyarrow.parquet  # noqa: F401  # only imported: its threads start at the first use

    import mavfi_cli.mission.run
    from mavfi_cli.autonomy import warm
    from mavfi_cli.mission.vehicle import VehicleInProcess

    assert mavfi_cli.mission.run
    warm.warm_up()
    VehicleInProcess.warm_up()


def perform(changes: Changes, out: Path) -> Path:
    """Fly a mission, given its `missions.changes_of`; return its run folder in `out`.

    Raises:
        MavfiError: the mission could not begin, or its record could not be written.
    """
    from mavfi_cli.core.config import structure
    from mavfi_cli.mission.instruction import CACHE
    from mavfi_cli.mission.progress import Watcher
    from mavfi_cli.mission.run import fly_mission
    from mavfi_cli.spec.mission import MissionConfig

    profiles = (out / CACHE).resolve()  # the runner has linked it to the campaign's profiles
    return fly_mission(structure(changes, MissionConfig), out, Watcher(), profiles=profiles).path
