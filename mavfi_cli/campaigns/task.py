"""The work of a campaign's worker: fly a mission, or a flight from which several are forked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mavfi_cli.campaigns.missions import Changes
from mavfi_cli.core.fork_server import Forks


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


def share(task: Mapping[str, Any], out: Path, forks: Forks) -> Path:
    """Fly missions that share a flight; return the run folder of a fork in its own folder.

    Args:
        task: "limit_s", and "missions" as triples of number, `missions.changes_of` and folder.
        out: folder of the shared flight, which keeps nothing.

    Raises:
        FlightShared: this process has flown the shared flight.
        MavfiError: the missions could not begin, or a record could not be written.
    """
    from mavfi_cli.core.config import structure
    from mavfi_cli.mission.progress import Watcher
    from mavfi_cli.mission.run import fly_mission
    from mavfi_cli.mission.shared_flight import Branch, SharedFlight
    from mavfi_cli.spec.mission import MissionConfig

    branches = {
        number: Branch(config=structure(changes, MissionConfig), out=Path(folder))
        for number, changes, folder in task["missions"]
    }

    def fork(number: int) -> bool:
        return forks.fork(number, branches[number].out, task["limit_s"])

    common = replace(next(iter(branches.values())).config, fault=None)
    return fly_mission(common, out, Watcher(), shared=SharedFlight(branches, fork)).path
