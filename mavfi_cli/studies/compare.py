"""`mavfi compare`: the same missions on several computers, as the preset fig16 has them.

The folder is that of a campaign; `timeline` in it is another, of one golden flight a platform with
its whole record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.flights import flights, rows_of
from mavfi_cli.analysis.platforms import GOLDEN, NONE, compared, figures
from mavfi_cli.analysis.timeline import timelines
from mavfi_cli.campaign.begin import begin
from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.ledger import LEDGER, Ledger
from mavfi_cli.campaign.missions import PlannedMission
from mavfi_cli.campaign.outcome import State
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options, fly_missing, run_campaign
from mavfi_cli.campaign.specification.difference import differences
from mavfi_cli.campaign.specification.spec import Setting, Spec, parse_spec
from mavfi_cli.core.config import require_distinct
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.platform import load_platform
from mavfi_cli.mission.record.run_folder import load_run
from mavfi_cli.mission.run import installed_versions
from mavfi_cli.mission.stack import DEFAULT

SCHEMA = 2  # 1 had the costs of faults among the worst cases
TIMELINE = "timeline"
FAULTY = "FI"  # settings are named as in the presets
_SHORT = {"gad": "G", "aad": "A"}  # of detectors, in the names of settings
STAGES = tuple(stage.value for stage in Stage)
MOST = 100_000  # missions


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparePlan:
    """What is compared. As it stands: the paper's Fig. 16, mission for mission the preset fig16.

    Attributes:
        platforms: names or files; the others are held against the first.
        inject: stages, states or groups that a fault strikes, one a flight; empty flies golden
            missions only.
        detectors: names; `none` may be among them or not, it is always flown.
        missions: of each platform and setting, and of each target of `inject`.
        first_seed: of the missions; seeds count up from here.
        seed: root of the faults' seeds.
        field: bit field that is struck; None draws any bit.
        stack: of all missions; a name, a file or a variant.

    Raises:
        ConfigError: nothing to fly, or something is named twice.
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
        named: dict[str, tuple[str, ...]] = {
            "platform": self.platforms,
            "detector": self.detectors,
            "inject": self.inject,
        }
        for key, names in named.items():
            if not names and key != "inject":
                raise ConfigError("name at least one", key=key)
        if not 1 <= self.missions <= MOST:
            limit = "least 1" if self.missions < 1 else f"most {MOST}"
            raise ConfigError(f"must be at {limit}, got {self.missions}", key="missions")
        for key in ("first_seed", "seed"):
            if getattr(self, key) < 0:
                raise ConfigError(f"must not be negative, got {getattr(self, key)}", key=key)
        if self.field is not None and not self.inject:
            raise ConfigError(f"{self.field}: there is no fault", key="field")
        files = [str(Path(n).resolve()) if n.endswith(".toml") else n for n in self.platforms]
        for key, names in (*named.items(), ("platform", tuple(files))):
            require_distinct(names, key)

    @property
    def settings(self) -> tuple[str, ...]:
        """Golden, `none`, and the detectors: what is flown on each platform."""
        protectors = tuple(name for name in self.detectors if name != NONE)
        return (GOLDEN, NONE, *protectors) if self.inject else (GOLDEN,)

    def spec(self) -> Spec:
        """The campaign."""
        axis = "stage" if set(self.inject) <= set(STAGES) else "site"
        faults: dict[str, tuple[Any, ...]] = {axis: self.inject}
        if self.field is not None:
            faults["field"] = (self.field,)
        settings = [Setting(name=GOLDEN)]
        for name in self.settings[1:]:
            detector = {} if name == NONE else {"detector": (name,)}
            told = FAULTY if name == NONE else f"D&R({_SHORT.get(name, name)})"
            settings.append(Setting(name=told, axes={**faults, **detector}))
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
        table = flights(ledger)
    found = figures(plan.platforms, plan.settings, compared(table))
    return {
        "schema": SCHEMA,
        "plan": plan_told(plan),
        "versions": installed_versions(),
        "errors": [
            f"mission {row['number']}: {row['reason']}"
            for row in rows_of(table, ["number", "state", "reason"])
            if row["state"] == State.ERROR.value
        ],
        **found,
        "timeline": _timelines(plan, found["flights"], folder / TIMELINE, options, spectator),
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
    profiles = {name: load_platform(name) for name in plan.platforms}
    return {
        **asdict(plan),
        "platforms": [
            {
                "platform": name,
                "title": names[name],
                "description": profile.description or profile.name,
                "cores": profile.cores,
                "power_w": profile.power_w,
                "kernel_latency_s": {k: each.latency_s for k, each in profile.kernels.items()},
            }
            for name, profile in profiles.items()
        ],
        "settings": list(plan.settings),
    }


def titles(platforms: Sequence[str]) -> dict[str, str]:
    """What platforms are called in tables and pictures: a file by its stem, where that tells."""
    short = [name.removesuffix(".toml").rpartition("/")[2] for name in platforms]
    return {
        name: stem if short.count(stem) == 1 else name
        for name, stem in zip(platforms, short, strict=True)
    }


# The timeline ---------------------------------------------------------------------------------


def _timelines(
    plan: ComparePlan,
    flown: Sequence[Mapping[str, Any]],
    folder: Path,
    options: Options,
    spectator: Spectator,
) -> dict[str, Any]:
    """What the kernels of a golden flight did, a row a platform; of those that flew."""
    seed = timeline_seed(plan, flown)
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


def timeline_seed(plan: ComparePlan, flown: Sequence[Mapping[str, Any]]) -> int:
    """The first mission that all platforms fly well and with a new plan on the way.

    Where there is none, the first that all fly well; where there is none of those, the first.
    """
    for least in (1, 0):
        by_seed: dict[int, set[str]] = {}
        for row in flown:
            won = row["setting"] == GOLDEN and row["outcome"] == "success"
            if won and (row["replans"] or 0) >= least:
                by_seed.setdefault(row["seed"], set()).add(row["platform"])
        complete = [seed for seed, names in by_seed.items() if len(names) == len(plan.platforms)]
        if complete:
            return min(complete)
    return plan.first_seed
