"""Defines a campaign's specification: factors, settings, repetitions, stopping rule, worlds."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import Any

from mavfi_cli.campaigns.missions import Label, Labels, PlannedMission, Sampling, naming
from mavfi_cli.core.config import structure, toml_text
from mavfi_cli.core.errors import ConfigError, UnknownName, nearest
from mavfi_cli.core.seeds import Stream
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

SAMPLE = 20  # `sampled` keeps about one success in 20, and `few` about one failure
_WORD = 1 << 32
Factors = Mapping[str, Any]  # values of factors by name, as in TOML


# Factors: what may differ between missions, and the record that has the field ---------------------


# Level at which a fault strikes -> the mission's field for it, and the dataclass of its value.
_LEVELS = {"source": ("fault", FaultConfig), "instruction": ("instruction", InstructionConfig)}
_SEEDED = {"seed": (*_LEVELS,), "invocation_seed": ("instruction",)}
# Names in a specification for a fault's field `target`, at either level.
_ALIASES = {"stage": "target", "site": "target"}
_NESTED = {"fault", "instruction", "detector"}  # written flat: see below
_NEVER = {"link", "realtime"}  # campaigns fly the simulated vehicle
# Factors that may differ even between missions without a fault.
MISSION = tuple(
    member.name for member in fields(MissionConfig) if member.name not in _NESTED | _NEVER
)
_DETECTOR = {"detector": "name"} | {
    member.name: member.name for member in fields(DetectorConfig) if member.name != "name"
}
_FAULT = {
    level: tuple(member.name for member in fields(record) if member.name not in _SEEDED)
    for level, (_, record) in _LEVELS.items()
}
_OF_FAULTS = dict.fromkeys((*_ALIASES, "level", *_FAULT["source"], *_FAULT["instruction"]))
NAMES = (*MISSION, *_DETECTOR, *(name for name in _OF_FAULTS if name != "target"))


def _mission_of(values: Factors, seed: int, fault_seeds: Mapping[str, int]) -> MissionConfig:
    mission = {name: values[name] for name in MISSION if name in values}
    mission["seed"] = values.get("seed", seed)
    mission |= _fault(values, fault_seeds)
    detector = {_DETECTOR[name]: value for name, value in values.items() if name in _DETECTOR}
    if detector and "name" not in detector:
        raise ConfigError(f"{', '.join(sorted(detector))}: requires a detector")
    if detector and detector["name"] != "none":
        mission["detector"] = detector
    return structure(mission, MissionConfig)


def _fault(values: Factors, seeds: Mapping[str, int]) -> Factors:
    """Return a mission's `fault` or `instruction` field as a dict, or {} if it has no fault."""
    given = {name: value for name, value in values.items() if name not in (*MISSION, *_DETECTOR)}
    level = given.pop("level", "source")
    if level not in [*_LEVELS]:
        raise ConfigError(f"must be {' or '.join(_LEVELS)}, got {level!r}", key="level")
    targets = [name for name in _ALIASES if name in given]
    if len(targets) > 1:
        raise ConfigError("name a stage or a site for the fault, not both")
    fault = {_ALIASES[name] if name in targets else name: value for name, value in given.items()}
    for name in fault:
        if name not in _FAULT[level]:
            match = nearest(name, (*_ALIASES, *_FAULT[level]))
            hint = f"; did you mean {match!r}?" if match else ""
            raise ConfigError(f"is not a factor of faults at {level} level{hint}", key=name)
    if targets:
        drawn = {name: seed for name, seed in seeds.items() if level in _SEEDED[name]}
        return {_LEVELS[level][0]: {**fault, **drawn}}
    if given or "level" in values:
        named = sorted({*given, *({"level"} & set(values))})
        raise ConfigError(f"{', '.join(named)}: requires a stage or a site")
    return {}


# Settings, repetitions, stopping rule, worlds -----------------------------------------------------


class Keep(Enum):
    """Policy that selects the run folders to keep. Every outcome except success is a failure."""

    NONE = "none"
    FEW = "few"  # one failure in SAMPLE
    FAILURES = "failures"
    SAMPLED = "sampled"  # all failures, and one success in SAMPLE
    ALL = "all"

    def wants(self, number: int, outcome: str | None) -> bool:
        """Return True if the run folder of mission `number`, with this outcome, is to be kept."""
        if self is Keep.ALL or self is Keep.NONE:
            return self is Keep.ALL
        mixed = number  # hashed, so that sampled flights cover all settings in whatever order
        for factor in (0x9E3779B1, 0x85EBCA6B):  # odd, so that no two numbers collide
            mixed = mixed * factor % _WORD
            mixed ^= mixed >> 15
        sampled = mixed < _WORD // SAMPLE
        if outcome == "success":
            return sampled and self is Keep.SAMPLED
        return sampled or self is not Keep.FEW


Flown = tuple[tuple[int, ...], ...]  # for each candidate, the replans of its golden runs


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedWorld:
    """The table `[fixed_world]` of a specification: worlds with one seed, and how it is chosen.

    Attributes:
        replans: smallest and largest accepted median of the number of replans in a golden run. None
            means no rule, so that only the worlds in `world_seed` are fixed.
        flights: number of golden runs per candidate; their seeds start at the campaign's first.
        candidates: world seeds from 1 to this number are tried; the first that satisfies the rule
            is chosen.
        worlds: the worlds that the rule covers; if empty, all worlds of the campaign except world
            files.
        world_seed: seed of every fixed world, given by the user or chosen by the rule.
        flown: for each world, the numbers of replans in the golden runs of candidates 1, 2, 3, ...;
            a candidate with runs that failed or could not begin has fewer than `flights` numbers.
    """

    replans: tuple[int, int] | None = None
    flights: int = 5
    candidates: int = 200
    worlds: tuple[str, ...] = ()
    world_seed: Mapping[str, int] = field(default_factory=dict)
    flown: Mapping[str, Flown] = field(default_factory=dict)

    def __post_init__(self) -> None:
        least, most = self.replans or (0, 0)
        if not 0 <= least <= most:
            raise ValueError(
                f"replans: must be [LEAST, MOST] with 0 <= LEAST <= MOST, got [{least}, {most}]"
            )
        if self.replans is None and not self.world_seed:
            raise ValueError("must have replans or world_seed, but has neither")
        if self.flights < 1 or self.candidates < 1:
            raise ValueError(
                "flights and candidates: must be at least 1, "
                f"got {self.flights} and {self.candidates}"
            )
        for world, seed in self.world_seed.items():
            if seed < 0:
                raise ValueError(f"world_seed.{world}: must be at least 0, got {seed}")

    def rules(self, world: str) -> bool:
        """Return True if this world is fixed, by the rule or by a given seed.

        A user's world file is covered only if it is named, because its boxes are already fixed.
        """
        named = world in self.worlds or world in self.world_seed
        ruled = self.replans is not None and not self.worlds and not world.endswith(".toml")
        return named or ruled

    def succeeds(self, replans: Sequence[int]) -> bool:
        """Return True if more than half of a candidate's golden runs succeeded."""
        return 2 * len(replans) > self.flights

    def fits(self, replans: Sequence[int]) -> bool:
        """Return True if a candidate satisfies the rule.

        Args:
            replans: number of replans in each golden run of the candidate that succeeded.
        """
        assert self.replans is not None
        least, most = self.replans
        return self.succeeds(replans) and least <= statistics.median(replans) <= most

    def describe(self, worlds: Container[str]) -> str:
        """Return the seeds of these worlds, and the rule, as one line. It is empty without both."""
        phrases = []
        for world, seed in self.world_seed.items():
            if world in worlds:
                flown = self.flown.get(world)
                median = "named" if flown is None else f"median {statistics.median(flown[-1]):g}"
                phrases.append(f"{world} {seed} ({median})")
        if self.replans is None:
            return f"world seeds: {', '.join(phrases)}" if phrases else ""
        return f"world seeds: {', '.join(phrases or ['none yet'])}; {self.rule()}"

    def rule(self) -> str:
        """Return the rule as a phrase, which is empty without a rule."""
        if self.replans is None:
            return ""
        least, most = self.replans
        often = f"{least} to {most} times" if most > least else f"{least} times"
        often = "once" if often == "1 times" else often
        return f"the first from 1 on whose golden flights replan {often} (median of {self.flights})"


Axes = Mapping[str, tuple[Any, ...]]
MOST = 1_000_000  # missions of one campaign
# Factors whose value is a list. A list of lists holds several values, which are crossed.
LISTS = ("start", "goal", "isolate", "protect", "exact_bits", "sites", "roles", "objects")


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """A group of missions. Its own factors are crossed with those that all settings share."""

    name: str = ""
    axes: Axes = field(default_factory=dict)
    repetitions: int | None = None  # None: as many as the campaign

    def __post_init__(self) -> None:
        if self.repetitions is not None and self.repetitions < 1:
            raise ValueError(f"repetitions: must be at least 1, got {self.repetitions}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """The rule that ends a setting once its success rate is precise enough.

    Attributes:
        margin: largest half-width of the Wilson interval of the success rate.
        confidence: confidence level of that interval.
        batch: number of a setting's missions between two checks of the interval.
    """

    margin: float
    confidence: float = 0.95
    batch: int = 20

    def __post_init__(self) -> None:
        if not (0.0 < self.margin < 0.5 and 0.0 < self.confidence < 1.0 and self.batch >= 1):
            raise ValueError(
                "margin must be between 0 and 0.5, confidence between 0 and 1, batch at least 1; "
                f"got {self.margin:g}, {self.confidence:g} and {self.batch}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Spec:
    """The specification of one campaign.

    Attributes:
        seed: root seed from which the seeds of all faults are derived.
        first_seed: seed of the first mission; repetition r flies with first_seed + r, or with
            first_seed + r // faults_per_invocation if several faults share an invocation.
        repetitions: missions for each combination of factors.
        faults_per_invocation: number of faults at instruction level that strike the same
            invocation of a node, in consecutive repetitions with one seed. Missions without such
            a fault are flown once for each seed.
        fixed: factors that all missions share.
        axes: crossed factors with their values.
        settings: groups of missions, crossed with `axes`.
        stop: the rule that ends settings early; None flies all missions.
        fixed_world: rule and seeds of fixed worlds; None means that every seed has its own world.
    """

    name: str  # name of the folder below campaigns/
    about: str = ""  # description, which `plan` prints
    seed: int = 1
    first_seed: int = 1
    repetitions: int = 1
    faults_per_invocation: int = 1
    keep: Keep = Keep.FAILURES  # run folders to keep: none, failures, sampled or all
    sampling: Sampling = Sampling.UNIFORM  # how faults are drawn: uniform or stratified
    fixed: Factors = field(default_factory=dict)
    axes: Axes = field(default_factory=dict)
    settings: tuple[Setting, ...] = (Setting(),)
    stop: Stop | None = None
    fixed_world: FixedWorld | None = None

    def __post_init__(self) -> None:
        plain = Path(self.name).name == self.name and self.name.isprintable()
        if not plain or self.name in ("", ".."):
            raise ValueError(f"name: must be the name of a folder, without '/', got {self.name!r}")
        least_values = {"seed": 0, "first_seed": 0, "repetitions": 1, "faults_per_invocation": 1}
        for name, least in least_values.items():
            if (value := getattr(self, name)) < least:
                raise ValueError(f"{name}: must be at least {least}, got {value}")
        if self.faults_per_invocation > 1 and (
            self.stop is not None or self.sampling is not Sampling.UNIFORM
        ):
            raise ValueError(
                "faults_per_invocation: must be 1 with a stopping rule or stratified sampling, "
                f"because both treat missions as independent; got {self.faults_per_invocation}"
            )
        named = {*self.fixed, *self.axes, *(name for own in self.settings for name in own.axes)}
        if self.sampling is not Sampling.UNIFORM and "companion" in named:
            raise ValueError(
                f"sampling: must be {Sampling.UNIFORM.value} with a user's companion, because its "
                f"faults have no strata; got {self.sampling.value}"
            )

    def scaled(self, scale: float) -> Spec:
        """Return the same campaign with its repetitions multiplied by `scale`, but at least one.

        Raises:
            ConfigError: the scale is not above 0 or not finite.
        """
        if not (math.isfinite(scale) and scale > 0.0):
            raise ConfigError(f"must be finite and above 0, got {scale:g}", key="scale")

        settings = tuple(
            replace(
                setting,
                repetitions=setting.repetitions and max(1, round(setting.repetitions * scale)),
            )
            for setting in self.settings
        )
        repetitions = max(1, round(self.repetitions * scale))
        return replace(self, repetitions=repetitions, settings=settings)

    def describe_worlds(self) -> str:
        """Return the fixed worlds and their rule as one line, which is empty without them."""
        flown = {kind.config.world for kind in self.kinds()}
        return "" if self.fixed_world is None else self.fixed_world.describe(flown)

    def in_worlds(self, worlds: str) -> Spec:
        """Return the same campaign in fixed worlds, or in many worlds, one for each seed.

        Args:
            worlds: `fixed` or `many`.

        Raises:
            ConfigError: the campaign has no fixed worlds.
        """
        if self.fixed_world is None:
            raise ConfigError(f"campaign {self.name!r} has no fixed worlds", key="worlds")
        if worlds == "fixed":
            return self
        return replace(self, name=f"{self.name}-many-worlds", fixed_world=None)

    def missions(self) -> list[PlannedMission]:
        """Return all missions, one repetition after another, so that all settings grow together.

        Raises:
            ConfigError: there are no missions or more than MOST, or a combination is invalid.
        """
        points = self._points()
        return [
            self._mission(values, labels, repetition)
            for repetition in range(max(count for *_, count in points))
            for values, labels, count in points
            if repetition < count
            and (
                repetition % self.faults_per_invocation == 0 or values.get("level") == "instruction"
            )
        ]

    def kinds(self) -> list[PlannedMission]:
        """Return the first mission of each combination of factors. The others differ only in seeds.

        Raises:
            ConfigError: as `missions`.
        """
        return [self._mission(values, labels, 0) for values, labels, _ in self._points()]

    def programs(self) -> frozenset[str]:
        """Return the programs that the missions execute. Raise the same errors as `kinds`."""
        return frozenset(name for kind in self.kinds() for name in kind.config.programs)

    def _points(self) -> list[tuple[Factors, Labels, int]]:
        """Return each combination of factors, with its labels and its number of repetitions."""
        crossed = [
            ({**self.axes, **setting.axes}, setting.name, setting.repetitions or self.repetitions)
            for setting in self.settings
        ]
        planned = sum(count * math.prod(map(len, axes.values())) for axes, _, count in crossed)
        if planned > MOST:
            raise ConfigError(
                f"campaign {self.name!r} must have at most {MOST} missions, got {planned}"
            )
        points: list[tuple[Factors, Labels, int]] = []
        for axes, name, count in crossed:
            for values in itertools.product(*axes.values()):
                chosen = dict(zip(axes, values, strict=True))
                labels: dict[str, Label] = {"setting": name} if name else {}
                for key, value in chosen.items():
                    if key != "seed":
                        several = isinstance(value, list | tuple)
                        labels[key] = "+".join(map(str, value)) if several else value
                points.append(({**self.fixed, **chosen}, labels, count))
        if not points:
            raise ConfigError(
                f"campaign {self.name!r} has no missions, because a list of values is empty"
            )
        return points

    def _mission(self, values: Factors, labels: Labels, repetition: int) -> PlannedMission:
        several = self.faults_per_invocation
        seed = values.get("seed", self.first_seed + repetition // several)
        # The fault's seed depends on the target; otherwise all states would share one draw. No
        # other factor changes it: a target gets the same fault with every detector and platform.
        target = next((str(values[name]) for name in _ALIASES if name in values), "")
        seeds = {"seed": Stream.FAULT.seed(self.seed, "campaign", seed, repetition, target)}
        if several > 1:
            place = ("invocation", seed, repetition // several, target)
            seeds["invocation_seed"] = Stream.FAULT.seed(self.seed, *place)
        with naming(labels):
            config = _mission_of(values, seed, seeds)
            if self.fixed_world is not None and config.world_seed is None:
                config = replace(config, world_seed=self.fixed_world.world_seed.get(config.world))
            return PlannedMission(config=config, labels=labels)

    def differences(self, other: Spec, repetitions: str = "repetitions") -> list[str]:
        """Return a phrase for each difference from `other` that affects the list of missions.

        In a phrase, `there` means this specification, and `here` means `other`.

        Args:
            repetitions: the word for repetitions in the descriptions.
        """
        there, here = self._choices(repetitions), other._choices(repetitions)
        if there == here:  # the same values in different settings
            there, here = self._by_setting(), other._by_setting()
        pairs = {key: (there.get(key), here.get(key)) for key in (*there, *here)}
        return [
            f"{key} {_listed(old)} there, {_listed(new)} here"
            for key, (old, new) in pairs.items()
            if old != new
        ]

    def _choices(self, repetitions: str) -> dict[str, list[Any]]:
        """Return the values of each factor and compared property, keyed by a phrase for each."""
        choices: dict[str, list[Any]] = {}
        for axes in (self.axes, *(setting.axes for setting in self.settings)):
            for name, values in axes.items():
                known = choices.setdefault(name, [])
                known += [value for value in values if value not in known]
        choices |= {f"mission.{name}": [value] for name, value in self.fixed.items()}
        if self.fixed_world is not None:
            choices["rule of fixed worlds"] = [self.fixed_world.rule()]
            seeds = self.fixed_world.world_seed.items()
            choices["fixed worlds"] = [f"{world} {seed}" for world, seed in seeds]
        return {
            **choices,
            repetitions: [self.repetitions],
            "faults per invocation": [self.faults_per_invocation],
            "first seed": [self.first_seed],
            "fault seed": [self.seed],
            "settings": [setting.name for setting in self.settings],
            "sampling": [self.sampling.value],
        }

    def _by_setting(self) -> dict[str, list[Any]]:
        choices = {name: list(values) for name, values in self.axes.items()}
        for number, setting in enumerate(self.settings):
            own = dict(setting.axes)
            if setting.repetitions is not None:
                own["repetitions"] = (setting.repetitions,)
            name = setting.name or number
            choices |= {f"{factor} of setting {name}": list(own[factor]) for factor in own}
        return choices

    def to_toml(self) -> str:
        """Return TOML that `parse_spec` reads as an equal specification."""
        names = ("name", "about", "seed", "first_seed", "repetitions")
        settings = []
        for setting in self.settings:
            own = {"name": setting.name or None, "repetitions": setting.repetitions}
            own = {key: value for key, value in own.items() if value is not None}
            settings.append({**own, **setting.axes})
        fixed = asdict(self.fixed_world) if self.fixed_world else {}
        tables = {
            "mission": self.fixed,
            "factors": self.axes,
            "setting": settings,
            "stop": asdict(self.stop) if self.stop else {},
            "fixed_world": {key: value for key, value in fixed.items() if value is not None},
        }
        plain = {name: getattr(self, name) for name in names}
        plain["keep"] = self.keep.value
        if self.faults_per_invocation > 1:
            plain["faults_per_invocation"] = self.faults_per_invocation
        if self.sampling is not Sampling.UNIFORM:  # otherwise the text equals that in old ledgers
            plain["sampling"] = self.sampling.value
        return toml_text({**plain, **tables})

    def sampled(self, sampling: Sampling) -> Spec:
        """Return the same campaign with this sampling method. A new method is added to its name.

        Raises:
            ConfigError: the campaign cannot use this sampling method.
        """
        if sampling is self.sampling:
            return self
        try:
            return replace(self, name=f"{self.name}-{sampling.value}", sampling=sampling)
        except ValueError as error:
            raise ConfigError(str(error)) from None


def _listed(values: Sequence[Any] | None) -> str:
    return ", ".join(map(str, values)) if values else "none"


def require_named(
    key: str, names: Sequence[str], known: Sequence[str] | None = None, least: int = 1
) -> None:
    """Check that there are at least `least` names, and that all of them are known and different.

    Raises:
        ConfigError: there are too few names, or one occurs twice.
        UnknownName: a name is not among `known`, if that is given.
    """
    if len(names) < least:
        raise ConfigError("must name at least one, got none", key=key)
    for place, name in enumerate(names):
        if known is not None and name not in known:
            raise UnknownName(key, name, known)
        if name in names[:place]:
            raise ConfigError(f"must not name {name} twice", key=key)
