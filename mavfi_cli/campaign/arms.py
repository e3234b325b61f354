"""The same missions flown in several ways, arms, and numbers of each beside a reference arm."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaign.outcome import MissionResult, State
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options, run_campaign
from mavfi_cli.core.types import Outcome
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.stats.bootstrap import Interval, interval
from mavfi_cli.stats.paired import McNemar, mcnemar
from mavfi_cli.stats.shares import Share, rate

Measure = Callable[[Mapping[str, Any]], float | None]  # of a result.json
Place = tuple[str, int]  # world and seed


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """One way to fly all missions."""

    group: str  # arms of one group are compared with each other
    name: str
    mission: MissionConfig  # without world and seed


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What an arm's missions came to.

    Attributes:
        results: result.json of every mission that was flown, by world and seed.
        errors: why missions could not be flown.
    """

    results: Mapping[Place, Mapping[str, Any]]
    errors: Sequence[str]

    @property
    def outcomes(self) -> dict[str, int]:
        """How many missions ended in each way, the most frequent first."""
        return dict(Counter(str(each["outcome"]) for each in self.results.values()).most_common())

    @property
    def success(self) -> Share:
        """With its Wilson interval."""
        return rate(sum(map(_succeeded, self.results.values())), len(self.results))

    def mean(self, measure: Measure) -> Interval:
        """Of the successful missions, with its bootstrap interval."""
        return interval(self.values(measure))

    def values(self, measure: Measure) -> list[float]:
        """Of the successful missions."""
        found = (measure(each) for each in self.results.values() if _succeeded(each))
        return [value for value in found if value is not None]


def arm_missions(
    arms: Sequence[Arm], worlds: Sequence[str], first_seed: int, missions: int
) -> list[PlannedMission]:
    """The list: mission by mission, so that pairs are complete wherever it is cut off."""
    return [
        PlannedMission(
            config=replace(arm.mission, world=world, seed=first_seed + number),
            labels={"group": arm.group, "arm": arm.name, "world": world},
            pair=f"{world}/{first_seed + number}",
        )
        for number in range(missions)
        for world in worlds
        for arm in arms
    ]


def fly_arms(
    missions: Sequence[PlannedMission], folder: Path, options: Options, spectator: Spectator
) -> dict[tuple[str, str], Flown]:
    """Fly what the folder has not yet; by group and arm.

    Missions that the folder has from another plan stay there and are not counted.

    Raises:
        MavfiError: as `run_campaign`.
    """
    wanted = {_row(mission) for mission in missions}
    results: dict[tuple[str, str], dict[Place, Mapping[str, Any]]] = {}
    errors: dict[tuple[str, str], list[str]] = {}
    for mission in missions:
        results.setdefault(_arm(mission), {})
        errors.setdefault(_arm(mission), [])
    with run_campaign(
        missions, folder, replace(options, keep=Keep.NONE), spectator, append=True
    ) as ledger:
        for entry in ledger.results():
            if _row(entry.mission) in wanted:
                _add(entry, results, errors)
    return {arm: Flown(results=results[arm], errors=errors[arm]) for arm in results}


def _add(
    entry: MissionResult,
    results: dict[tuple[str, str], dict[Place, Mapping[str, Any]]],
    errors: dict[tuple[str, str], list[str]],
) -> None:
    arm, config = _arm(entry.mission), entry.mission.config
    if entry.state is State.ERROR:
        errors[arm].append(entry.reason)
    else:
        results[arm][config.world, config.seed] = entry.result


def _arm(mission: PlannedMission) -> tuple[str, str]:
    return str(mission.labels["group"]), str(mission.labels["arm"])


def _row(mission: PlannedMission) -> tuple[str, str]:
    return canonical(dict(mission.labels)), canonical(changes_of(mission.config))


def paired_ratio(
    first: Flown, second: Flown, of_first: Measure, of_second: Measure | None = None
) -> Interval:
    """Second over first, over the missions in which both succeeded: the geometric mean.

    Its interval is the bootstrap's of the mean logarithm.

    Args:
        of_second: what is measured in the second, where that is not the same.
    """
    measure = of_second or of_first
    pairs = ((of_first(a), measure(b)) for a, b in _pairs(first, second) if _both(a, b))
    logs = [math.log(b / a) for a, b in pairs if a and b]
    found = interval(logs)
    return Interval(
        value=math.exp(found.value),
        low=math.exp(found.low),
        high=math.exp(found.high),
        count=found.count,
    )


def paired_success(first: Flown, second: Flown) -> McNemar:
    """McNemar's test of the missions that both flew."""
    return mcnemar((_succeeded(a), _succeeded(b)) for a, b in _pairs(first, second))


def _pairs(first: Flown, second: Flown) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    return (
        (first.results[place], second.results[place])
        for place in sorted(first.results.keys() & second.results.keys())
    )


def _both(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    return _succeeded(first) and _succeeded(second)


def _succeeded(result: Mapping[str, Any]) -> bool:
    return bool(result["outcome"] == Outcome.SUCCESS.value)
