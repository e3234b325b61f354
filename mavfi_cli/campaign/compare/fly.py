"""Fly a comparison into its folder, and say what came of it.

The folder is that of a campaign; `timeline` in it is another, of one golden flight a platform with
its whole record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.begin import begin
from mavfi_cli.campaign.compare.figures import figures
from mavfi_cli.campaign.compare.flights import Flown, flights_of
from mavfi_cli.campaign.compare.plan import GOLDEN, ComparePlan, titles
from mavfi_cli.campaign.compare.timeline import timelines
from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.ledger import LEDGER, Ledger
from mavfi_cli.campaign.missions import PlannedMission
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options, fly_missing, run_campaign
from mavfi_cli.campaign.specification.difference import differences
from mavfi_cli.campaign.specification.spec import Spec, parse_spec
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.platform import load_platform
from mavfi_cli.mission.record.run_folder import load_run
from mavfi_cli.mission.run import installed_versions

SCHEMA = 2  # 1 had the costs of faults among the worst cases
TIMELINE = "timeline"


def compare(
    plan: ComparePlan, folder: Path, options: Options, spectator: Spectator
) -> dict[str, Any]:
    """Fly what the folder has not yet, and say how the platforms compare.

    Returns:
        Plain values: what `compare.json` holds.

    Raises:
        UnknownName, VehicleProcessError: a platform, world, state or detector that does not exist.
        ConfigError: the folder holds another comparison, or other versions flew in it.
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    spec, grows = _campaign(plan.spec(), folder)
    with begin(spec, folder, append=grows) as ledger:
        fly_missing(ledger, replace(options, keep=Keep.NONE), spectator)
        flights, errors = flights_of(ledger)
    return {
        "schema": SCHEMA,
        "plan": plan_told(plan),
        "versions": installed_versions(),
        "errors": errors,
        **figures(plan, flights),
        "timeline": _timelines(plan, flights, folder / TIMELINE, options, spectator),
    }


def _campaign(asked: Spec, folder: Path) -> tuple[Spec, bool]:
    """The campaign to fly in a folder, and whether its list grows.

    More missions of the same comparison go on from fewer: lists grow repetition by repetition.

    Raises:
        ConfigError: the folder holds another one; says in what it differs.
    """
    if not (folder / LEDGER).is_file():
        return asked, False
    with Ledger(folder) as ledger:
        text = ledger.meta("spec")
    if text is None:  # killed before it was said, or no comparison: the list will tell
        return asked, False
    stored = parse_spec(text, folder / LEDGER)
    ours = replace(asked, name=stored.name, about=stored.about, keep=stored.keep)
    grows = asked.repetitions > stored.repetitions
    alike = replace(ours, repetitions=stored.repetitions) if grows else ours
    found = differences(stored, alike, repetitions="missions")
    if found:
        raise ConfigError(
            f"holds another comparison: {'; '.join(found)}; choose another --out", path=folder
        )
    return ours, grows


def plan_told(plan: ComparePlan) -> dict[str, Any]:
    """What is compared, with what the platforms are, as plain values."""
    names = titles(plan.platforms)
    return {
        **asdict(plan),
        "platforms": [_platform(name, names[name]) for name in plan.platforms],
        "settings": list(plan.settings),
    }


def _platform(name: str, title: str) -> dict[str, Any]:
    profile = load_platform(name)
    return {
        "platform": name,
        "title": title,
        "description": profile.description or profile.name,
        "cores": profile.cores,
        "power_w": profile.power_w,
        "kernel_latency_s": {
            kernel: latency.latency_s for kernel, latency in profile.kernels.items()
        },
    }


# The timeline


def _timelines(
    plan: ComparePlan,
    flights: Sequence[Flown],
    folder: Path,
    options: Options,
    spectator: Spectator,
) -> dict[str, Any]:
    """What the kernels of a golden flight did, a row a platform; of those that flew."""
    seed = timeline_seed(plan, flights)
    missions = {name: _golden(plan, name, seed) for name in plan.platforms}
    spectator.on_note(f"the golden flights of seed {seed} again, for the timeline")
    with run_campaign(
        list(missions.values()), folder, replace(options, keep=Keep.ALL), spectator, append=True
    ) as ledger:
        paths = {each.mission.pair: each.path for each in ledger.results()}
    runs = {
        name: load_run(path)
        for name, mission in missions.items()
        if (path := paths.get(mission.pair)) is not None
    }
    return {"seed": seed, "platforms": timelines(runs)}


def timeline_seed(plan: ComparePlan, flights: Sequence[Flown]) -> int:
    """The first mission that all platforms fly well and with a new plan on the way.

    Where there is none, the first that all fly well; where there is none of those, the first.
    """
    golden = [each for each in flights if each.setting == GOLDEN and each.succeeded]
    for least in (1, 0):
        by_seed: dict[int, set[str]] = {}
        for each in golden:
            if each.replans >= least:
                by_seed.setdefault(each.seed, set()).add(each.platform)
        complete = [seed for seed, flown in by_seed.items() if len(flown) == len(plan.platforms)]
        if complete:
            return min(complete)
    return plan.first_seed


def _golden(plan: ComparePlan, platform: str, seed: int) -> PlannedMission:
    config = MissionConfig(world=plan.world, platform=platform, stack=plan.stack, seed=seed)
    return PlannedMission(config=config, labels={"platform": platform})
