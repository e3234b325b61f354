"""The work of a campaign's worker: fly a mission, or a flight from which several are forked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

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


def perform(task: Mapping[str, Any], out: Path, forks: Forks | None = None) -> Path:
    """Fly a mission, or several that share a flight; return the run folder in its own folder.

    Args:
        task: a mission's `missions.changes_of`. With `forks`: "limit_s", and "missions" as triples
            of number, changes and folder.
        out: folder of the mission, or of the shared flight, which keeps nothing.

    Raises:
        SystemExit: this process has flown the shared flight.
        MavfiError: the mission could not begin, or its record could not be written.
    """
    from mavfi_cli.core.config import structure
    from mavfi_cli.mission.instruction import CACHE
    from mavfi_cli.mission.progress import Watcher
    from mavfi_cli.mission.run import fly_mission
    from mavfi_cli.mission.shared_flight import SharedFlight
    from mavfi_cli.spec.mission import MissionConfig

    if forks is None:
        config = structure(task, MissionConfig)
        profiles = (out / CACHE).resolve()  # the runner has linked it to the campaign's profiles
        return fly_mission(config, out, Watcher(), profiles=profiles).path
    branches = {
        number: (structure(changes, MissionConfig), Path(folder))
        for number, changes, folder in task["missions"]
    }

    def fork(number: int) -> bool:
        return forks.fork(number, branches[number][1], task["limit_s"])

    first, _ = next(iter(branches.values()))
    shared = SharedFlight(branches, fork)
    return fly_mission(replace(first, fault=None), out, Watcher(), shared=shared).path
