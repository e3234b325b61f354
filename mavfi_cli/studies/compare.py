"""`mavfi compare`: the same missions on several platforms, as in the preset fig16.

The output folder holds a campaign. Its subfolder `timeline` holds another campaign, with the
complete records of one golden flight per platform.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.flights import errors, flights
from mavfi_cli.analysis.platforms import (
    GOLDEN,
    NONE,
    ComparedPlan,
    ComparedTimelines,
    PlatformComparison,
    compared,
    figures,
    summaries,
)
from mavfi_cli.analysis.timeline import timeline_seed, timelines
from mavfi_cli.campaigns.begin import begin, resumed
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, fly_missing
from mavfi_cli.campaigns.specification import Keep, Setting, Spec, require_named
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.installed import installed_versions
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.studies import fly

FAULTY = "FI"  # names of settings, as in the presets
_SHORT = {"gad": "G", "aad": "A"}  # short names of detectors in names of settings
STAGES = tuple(stage.value for stage in Stage)
MOST = 100_000  # missions
SCHEMA = 2  # of compare.json


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparePlan:
    """The plan of a comparison of platforms: which missions each platform flies.

    The defaults are those of the preset `fig16` with a different world for each seed (Fig. 16).

    Attributes:
        platforms: names or files; the others are compared with the first one.
        inject: stages, states or groups to corrupt, one per flight; if empty, only
            golden flights are flown.
        detectors: names; `none` is always flown, even if it is not named.
        missions: number of missions per platform, setting and target of `inject`.
        seed: root of the faults' seeds.
        field: bit field to strike; if None, any bit may be drawn.
    """

    platforms: tuple[str, ...] = ("x86", "tx2")
    world: str = "sparse"
    inject: tuple[str, ...] = STAGES
    detectors: tuple[str, ...] = (NONE, "gad", "aad")
    missions: int = 100
    first_seed: int = 1
    seed: int = 1
    field: str | None = None
    stack: str = DEFAULT

    def __post_init__(self) -> None:
        for key, names in (("platform", self.platforms), ("detector", self.detectors)):
            require_named(key, names)
        require_named("inject", self.inject, least=0)
        files = [str(Path(n).resolve()) if n.endswith(".toml") else n for n in self.platforms]
        require_named("platform", files)
        if not 1 <= self.missions <= MOST:
            limit = "least 1" if self.missions < 1 else f"most {MOST}"
            raise ConfigError(f"must be at {limit}, got {self.missions}", key="missions")
        for key in ("first_seed", "seed"):
            if getattr(self, key) < 0:
                raise ConfigError(f"must be at least 0, got {getattr(self, key)}", key=key)
        if self.field is not None and not self.inject:
            raise ConfigError(f"has no effect without a fault, got {self.field}", key="field")

    @property
    def settings(self) -> tuple[str, ...]:
        """The names of the settings that each platform flies.

        They are `golden` and, if faults are injected, `none` and the other detectors.
        """
        protectors = tuple(name for name in self.detectors if name != NONE)
        return (GOLDEN, NONE, *protectors) if self.inject else (GOLDEN,)

    def described(self) -> ComparedPlan:
        """Return the plan for the report, with a summary of each platform in place of its name."""
        own = {part.name: getattr(self, part.name) for part in fields(self)}
        return ComparedPlan(**{**own, "platforms": summaries(self.platforms)},
                            settings=self.settings)  # fmt: skip

    def spec(self) -> Spec:
        """Return the specification of the campaign that flies this plan."""
        faults: dict[str, tuple[Any, ...]] = {
            "stage" if set(self.inject) <= set(STAGES) else "site": self.inject,
            **({} if self.field is None else {"field": (self.field,)}),
        }
        settings = [Setting(name=GOLDEN)]
        for name in self.settings[1:]:
            detector = {} if name == NONE else {"detector": (name,)}
            title = FAULTY if name == NONE else f"D&R({_SHORT.get(name, name)})"
            settings.append(Setting(name=title, axes={**faults, **detector}))
        return Spec(
            name="compare",
            about="The same missions on several computers",
            seed=self.seed,
            first_seed=self.first_seed,
            repetitions=self.missions,
            keep=Keep.NONE,
            fixed={} if self.stack == DEFAULT else {"stack": self.stack},
            axes={"world": (self.world,), "platform": self.platforms},
            settings=tuple(settings),
        )


def compare(
    plan: ComparePlan, folder: Path, options: Options, spectator: Spectator
) -> PlatformComparison:
    """Fly the missions of a plan that have no result in `folder` yet, and compare the platforms.

    Raises:
        ConfigError: the folder holds another comparison.
        MavfiError: as `begin` and `run_campaign`.
    """
    spec, grows = resumed(plan.spec(), folder, "comparison", repetitions="missions")
    with begin(spec, folder, append=grows) as ledger:
        fly_missing(ledger, replace(options, keep=Keep.NONE), spectator)
        table = flights(ledger)
    flown = compared(table)
    seed = timeline_seed(flown.table, plan.platforms) or plan.first_seed
    return figures(
        plan.described(),
        flown,
        schema=SCHEMA,
        versions=installed_versions(),
        errors=errors(table, "mission {number}: {reason}"),
        timeline=_timelines(plan, seed, folder / "timeline", options, spectator),
    )


def _timelines(
    plan: ComparePlan, seed: int, folder: Path, options: Options, spectator: Spectator
) -> ComparedTimelines:
    spectator.on_note(f"the golden flights of seed {seed} again, for the timeline")
    golden = MissionConfig(world=plan.world, stack=plan.stack, seed=seed)
    missions = [
        PlannedMission(config=replace(golden, platform=name), labels={"platform": name})
        for name in plan.platforms
    ]
    table = fly(missions, folder, Keep.ALL, options, spectator)
    paths = dict(zip(table["platform"].to_pylist(), table["path"].to_pylist(), strict=True))
    runs = {name: load_run(Path(paths[name])) for name in plan.platforms if paths.get(name)}
    return ComparedTimelines(seed=seed, platforms=timelines(runs))
