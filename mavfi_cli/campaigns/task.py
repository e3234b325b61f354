"""The task of a campaign's worker: fly one mission, or a flight from which several fork."""

from __future__ import annotations

import contextlib
import io
import itertools
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from mavfi_cli.core.fork_server import Forks


def prepare() -> None:
    """Import and load everything that a mission needs, before workers are forked."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    import mavfi_cli.mission.run
    from mavfi_cli.autonomy import warm
    from mavfi_cli.core.config import structure
    from mavfi_cli.mission.vehicle import VehicleInProcess
    from mavfi_cli.spec.mission import MissionConfig

    assert mavfi_cli.mission.run
    warm.warm_up()
    # cattrs generates the code that reads a table when it first reads one.
    structure({"fault": {"target": "waypoint_x"}, "detector": {"name": "gad"}}, MissionConfig)
    structure({"instruction": {"target": "planner"}}, MissionConfig)
    VehicleInProcess.warm_up()
    table = pa.table({"": [0.0]})  # pyarrow imports pandas, if installed, at its first array
    pq.write_table(table, io.BytesIO(), compression="zstd")


def perform(task: Mapping[str, Any], out: Path, forks: Forks | None = None) -> Path:
    """Fly a mission, or several that share a flight. Return the run folder of this process.

    Args:
        task: "missions", triples of a number, the changes from `missions.changes_of` and a folder;
            "limit_s", the wall time limit of each mission, in seconds; "alone", the reason why a
            mission does not share a flight, or "".
        out: folder of the mission, or of the shared flight, whose files are not kept.
        forks: forks this process for each mission of a shared flight; None for a single mission.

    Raises:
        SystemExit: this process has flown only the shared flight, which is not a mission itself.
        MavfiError: the mission could not begin, or its record could not be written.
    """
    from mavfi_cli.core.config import structure
    from mavfi_cli.core.files import leave_unsynced
    from mavfi_cli.core.processes import leave_network
    from mavfi_cli.mission.instruction import CACHE
    from mavfi_cli.mission.progress import Watcher
    from mavfi_cli.mission.run import fly_golden, fly_mission
    from mavfi_cli.mission.shared_flight import SharedFlight
    from mavfi_cli.spec.companion import CompanionConfig
    from mavfi_cli.spec.mission import MissionConfig

    leave_unsynced(out.parent)  # the runner removes the folder, or syncs what it keeps
    branches = {
        number: (structure(changes, MissionConfig), Path(folder))
        for number, changes, folder in task["missions"]
    }
    config, folder = next(iter(branches.values()))
    profiles = (folder / CACHE).resolve()  # the runner has linked it to the campaign's profiles
    if config.companion is not None and CompanionConfig.load(config.companion).own_network:
        leave_network()
    if forks is None:
        host = {"alone": task["alone"]} if task["alone"] else {}
        return fly_mission(config, out, Watcher(), profiles=profiles, host=host).path

    def fork(number: int) -> bool:
        return forks.fork(number, branches[number][1], task["limit_s"])

    strike, reasons = None, list[str]()
    if any(config.instruction is not None for config, _ in branches.values()):
        from mavfi_cli.mission.instruction.injection import keep_orders, struck_nodes

        if config.detector is not None:  # a detector may change the requests to nodes
            keep_orders(config.golden, profiles, fly_golden)
        strike = partial(struck_nodes, profiles=profiles, omit=reasons.append)
    flown = config.shared_flight
    assert flown is not None
    first = SharedFlight(branches, fork, strike, reasons.append)
    for shared in itertools.chain([first], first.further()):
        with contextlib.suppress(SystemExit):
            return fly_mission(flown, out, Watcher(), shared=shared).path
    raise SystemExit("; ".join(dict.fromkeys(reasons)))  # why missions were not forked
