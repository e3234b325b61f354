"""Searches for fixed worlds: candidates get golden runs in turn until one fits the rule.

The search is a separate campaign in a subfolder of the campaign. An interrupted search continues
where it stopped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import FixedWorld, Flown, Keep, Spec
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.mission.record.measures import fields_of
from mavfi_cli.spec.mission import MissionConfig

SEARCH = "world-search"  # the folder
_AT_ONCE = 4  # candidates that are flown at the same time


def with_worlds(
    spec: Spec,
    missions: Sequence[PlannedMission],
    folder: Path,
    options: Options,
    spectator: Spectator,
) -> Spec:
    """Return the specification with a seed for every world that the rule is for.

    A world is judged by the first mission in it, flown without fault and protection. The first
    mission has the first of all values, so all stacks and platforms share one world.

    Args:
        missions: missions of the specification.
        folder: folder of the campaign.

    Raises:
        ConfigError: no candidate fits.
        MavfiError: as `run_campaign`.
    """
    rule = spec.fixed_world
    if rule is None:
        return spec
    judged: dict[str, MissionConfig] = {}
    for mission in missions:
        config = mission.config
        if config.world_seed is None and rule.rules(config.world):
            judged.setdefault(config.world, config.golden)
    for world, config in judged.items():
        flown = _search(rule, config, spec.first_seed, folder / SEARCH, options, spectator)
        rule = replace(
            rule,
            world_seed={**rule.world_seed, world: len(flown)},
            flown={**rule.flown, world: flown},
        )
        spectator.on_note(f"fixed world {world}: seed {len(flown)}")
    return replace(spec, fixed_world=rule)


def _search(
    rule: FixedWorld,
    config: MissionConfig,
    first_seed: int,
    folder: Path,
    options: Options,
    spectator: Spectator,
) -> Flown:
    """Find the replans of candidates 1, 2, 3, ... up to the one that fits."""
    flown: Flown = ()
    for first in range(1, rule.candidates + 1, _AT_ONCE):
        last = min(first + _AT_ONCE - 1, rule.candidates)
        spectator.on_note(f"fixed world {config.world}: seeds {first} to {last} are flown")
        missions = {
            seed: [
                replace(config, world_seed=seed, seed=first_seed + flight)
                for flight in range(rule.flights)
            ]
            for seed in range(first, last + 1)
        }
        replans = _replans(missions, folder, options, spectator)
        for seed, configs in missions.items():
            counts = (replans[each] for each in configs)
            flown = (*flown, tuple(count for count in counts if count is not None))
            if rule.fits(flown[-1]):
                return flown[:seed]
    often = sorted(count for replans in flown for count in replans)
    seen = f"; they replan {often[0]} to {often[-1]} times" if often else ""
    raise ConfigError(
        f"no world seed of {config.world} up to {rule.candidates} is {rule.rule()}{seen}; leave "
        f"the world out of `worlds`, or name its seed in [fixed_world.world_seed]",
        key="fixed_world",
    )


def _replans(
    missions: dict[int, list[MissionConfig]], folder: Path, options: Options, spectator: Spectator
) -> dict[MissionConfig, int | None]:
    """The number of replans of each flight; None if it could not begin."""
    planned = [
        PlannedMission(config=config, labels={"world": config.world, "world_seed": seed})
        for seed, configs in missions.items()
        for config in configs
    ]
    quiet = replace(options, keep=Keep.NONE)
    notes = Spectator()  # without progress: that of a search is not the campaign's
    notes.on_note = spectator.on_note  # type: ignore[method-assign]
    with run_campaign(planned, folder, quiet, notes, append=True) as ledger:
        return {each.mission.config: fields_of(each.result)["replans"] for each in ledger.results()}
