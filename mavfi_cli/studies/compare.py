"""`mavfi compare`: the same missions on several platforms, as in the preset fig16.

The folder is a campaign's. Its folder `timeline` is a campaign of one golden flight per platform
with the whole record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.flights import flights, rows_of
from mavfi_cli.analysis.platforms import compared, figures
from mavfi_cli.analysis.timeline import timeline_seed, timelines
from mavfi_cli.campaign.begin import begin, resumed
from mavfi_cli.campaign.missions import PlannedMission, ResultState
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options, fly_missing, run_campaign
from mavfi_cli.campaign.specification import Keep
from mavfi_cli.core.versions import installed_versions
from mavfi_cli.mission.record.run_folder import load_run
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.studies.compare_plan import ComparePlan

SCHEMA = 2  # version 1 listed the costs of faults with the worst cases
TIMELINE = "timeline"


def compare(
    plan: ComparePlan, folder: Path, options: Options, spectator: Spectator
) -> dict[str, Any]:
    """Fly the missing missions of the folder, and compare the platforms.

    Returns:
        Plain values, the contents of `compare.json`.

    Raises:
        UnknownName, VehicleProcessError: a platform, world, state or detector that does not exist.
        ConfigError: the folder holds another comparison, or other versions flew in it.
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    spec, grows = resumed(plan.spec(), folder, "comparison", repetitions="missions")
    with begin(spec, folder, append=grows) as ledger:
        fly_missing(ledger, replace(options, keep=Keep.NONE), spectator)
        table = flights(ledger)
    found = figures(plan.platforms, plan.settings, compared(table))
    return {
        "schema": SCHEMA,
        "plan": plan.told(),
        "versions": installed_versions(),
        "errors": [
            f"mission {row['number']}: {row['reason']}"
            for row in rows_of(table, ["number", "state", "reason"])
            if row["state"] == ResultState.ERROR.value
        ],
        **found,
        "timeline": _timelines(plan, found["flights"], folder / TIMELINE, options, spectator),
    }


def _timelines(
    plan: ComparePlan,
    flown: Sequence[Mapping[str, Any]],
    folder: Path,
    options: Options,
    spectator: Spectator,
) -> dict[str, Any]:
    """Kernel invocations of a golden flight, one row per platform that flew."""
    seed = timeline_seed(flown, plan.platforms) or plan.first_seed
    spectator.on_note(f"the golden flights of seed {seed} again, for the timeline")
    missions = {
        name: PlannedMission(
            config=MissionConfig(world=plan.world, platform=name, stack=plan.stack, seed=seed),
            labels={"platform": name},
        )
        for name in plan.platforms
    }
    with run_campaign(
        [*missions.values()], folder, replace(options, keep=Keep.ALL), spectator, append=True
    ) as ledger:
        paths = {each.mission.pair: each.path for each in ledger.results()}
    runs = {
        name: load_run(path)
        for name, mission in missions.items()
        if (path := paths.get(mission.pair)) is not None
    }
    return {"seed": seed, "platforms": timelines(runs)}
