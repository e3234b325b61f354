"""The specification of a campaign: campaign.toml, and the presets."""

from __future__ import annotations

import datetime
import itertools
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

from mavfi_cli.autonomy.planner_names import canonical
from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.missions import Label, PlannedMission, naming
from mavfi_cli.campaign.specification.factors import NAMES, Point
from mavfi_cli.campaign.specification.fixed_world import FixedWorld
from mavfi_cli.core.config import structure, syntax_error
from mavfi_cli.core.errors import ConfigError, UnknownKey, UnknownName
from mavfi_cli.core.seeds import Stream, derive

Axes = Mapping[str, tuple[Any, ...]]
_TOP = ("name", "about", "seed", "first_seed", "repetitions", "keep", "mission", "factors",
        "setting", "stop", "fixed_world")  # fmt: skip
_SETTING = ("name", "repetitions")
MOST = 1_000_000  # missions of one campaign
# Factors whose value is a list already: a list of lists crosses several.
LISTS = ("start", "goal", "isolate", "protect", "exact_bits", "sites", "roles")
_NO_VALUES = (datetime.date, datetime.time)  # types that TOML has and factors do not


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Missions that are listed together: their own factors, crossed with the common ones."""

    name: str = ""
    axes: Axes = field(default_factory=dict)
    repetitions: int | None = None  # None: as many as the campaign has


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """When a setting has been flown often enough.

    Attributes:
        margin: largest half-width of the Wilson interval of the success rate.
        confidence: confidence of that interval.
        batch: the interval is checked after every batch of this many missions of a setting.
    """

    margin: float
    confidence: float = 0.95
    batch: int = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Spec:
    """One campaign.

    Attributes:
        seed: root of the seeds of all faults.
        first_seed: first seed of the missions; repetition r flies with first_seed + r.
        repetitions: missions for each combination of factors.
        fixed: factors that all missions share.
        axes: factors that are crossed, each with its values.
        settings: lists of missions, each crossed with `axes`.
        stop: ends settings early; None flies everything.
        fixed_world: has missions in a world share one; None: the world changes with the seed.
    """

    name: str
    about: str = ""
    seed: int = 1
    first_seed: int = 1
    repetitions: int = 1
    keep: Keep = Keep.FAILURES
    fixed: Mapping[str, Any] = field(default_factory=dict)
    axes: Axes = field(default_factory=dict)
    settings: tuple[Setting, ...] = (Setting(),)
    stop: Stop | None = None
    fixed_world: FixedWorld | None = None

    def scaled(self, scale: float) -> Spec:
        """Return the same campaign with a fraction of its repetitions, at least one each.

        Raises:
            ConfigError: the scale leaves nothing.
        """
        if not (math.isfinite(scale) and scale > 0.0):
            raise ConfigError(f"must be above 0, got {scale:g}", key="scale")

        def share(count: int) -> int:
            """Scale a number of repetitions, to at least one."""
            return max(1, round(count * scale))

        settings = tuple(
            setting
            if setting.repetitions is None
            else replace(setting, repetitions=share(setting.repetitions))
            for setting in self.settings
        )
        return replace(self, repetitions=share(self.repetitions), settings=settings)

    def missions(self) -> list[PlannedMission]:
        """List the missions repetition by repetition, so that pairs and settings grow together.

        Raises:
            ConfigError: there is nothing to fly, more than MOST, or a combination makes no mission.
        """
        points = self._points()
        return [
            self._mission(point, labels, repetition)
            for repetition in range(max(count for *_, count in points))
            for point, labels, count in points
            if repetition < count
        ]

    def kinds(self) -> list[PlannedMission]:
        """The first missions of the list, one for each combination; the others differ in seeds.

        Raises:
            ConfigError: as `missions`.
        """
        return [self._mission(point, labels, 0) for point, labels, _ in self._points()]

    def _points(self) -> list[tuple[Point, dict[str, Label], int]]:
        """Combine the factors; return each combination with its labels and repetitions."""
        if (planned := sum(self._size(setting) for setting in self.settings)) > MOST:
            raise ConfigError(f"campaign {self.name!r} has {planned} missions; at most {MOST}")
        points = [
            (Point(values={**self.fixed, **values}), labels, self._count(setting))
            for setting in self.settings
            for values, labels in self._combinations(setting)
        ]
        if not points:
            raise ConfigError(f"campaign {self.name!r} has no mission: an empty list of values")
        return points

    def _count(self, setting: Setting) -> int:
        return self.repetitions if setting.repetitions is None else setting.repetitions

    def _size(self, setting: Setting) -> int:
        """Number of missions of a setting, without making them."""
        return self._count(setting) * math.prod(map(len, {**self.axes, **setting.axes}.values()))

    def _combinations(self, setting: Setting) -> Iterator[tuple[dict[str, Any], dict[str, Label]]]:
        axes = {**self.axes, **setting.axes}
        named = {"setting": setting.name} if setting.name else {}
        for values in itertools.product(*axes.values()):
            chosen = dict(zip(axes, values, strict=True))
            varied = {name: value for name, value in chosen.items() if name != "seed"}
            yield chosen, {**named, **{name: _label(value) for name, value in varied.items()}}

    def _mission(
        self, point: Point, labels: Mapping[str, Label], repetition: int
    ) -> PlannedMission:
        seed = point.values.get("seed", self.first_seed + repetition)
        # The target is part of it, or the faults of all states would share one draw. Nothing else
        # is: the same target gets the same fault under every detector and platform.
        fault_seed = derive(self.seed, Stream.FAULT, "campaign", seed, repetition, point.target)
        with naming(labels):
            config = point.mission(seed, fault_seed)
            if self.fixed_world is not None and config.world_seed is None:
                config = replace(config, world_seed=self.fixed_world.world_seed.get(config.world))
            return PlannedMission(config=config, labels=labels)


def _label(value: Any) -> Label:
    return "+".join(map(str, value)) if isinstance(value, list | tuple) else value


def presets() -> tuple[str, ...]:
    """The names of the campaigns that come with mavfi."""
    folder = resources.files("mavfi_cli.campaign.presets")
    return tuple(
        sorted(each.name.removesuffix(".toml") for each in folder.iterdir()
               if each.name.endswith(".toml"))
    )  # fmt: skip


def load_spec(name: str) -> Spec:
    """Load a preset, or the specification in a TOML file.

    Raises:
        UnknownName: neither a preset nor a file.
        ConfigError: the file cannot be used; says where and why.
    """
    path = Path(name)
    if path.suffix != ".toml":
        if name not in presets():
            raise UnknownName("campaign", name, presets())
        text = (resources.files("mavfi_cli.campaign.presets") / f"{name}.toml").read_text("utf-8")
        return parse_spec(text, Path(f"{name}.toml"))
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(error.strerror or str(error), path=path) from None
    except UnicodeDecodeError:
        raise ConfigError("not a UTF-8 text file", path=path) from None
    return parse_spec(text, path)


def parse_spec(text: str, path: Path) -> Spec:
    """Parse a specification in TOML; `path` is for messages and the default name."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise syntax_error(error, path) from None
    return read_spec(data, path)


def read_spec(data: Mapping[str, Any], path: Path) -> Spec:
    """Read a specification from TOML's tables; `path` as for `parse_spec`."""
    return _Reader(path).spec(data)


class _Reader:
    """Reads the tables of one file; its errors name the table."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def spec(self, data: Mapping[str, Any]) -> Spec:
        """Read the whole file."""
        self._known(data, _TOP, "")
        settings = data.get("setting", [{}])
        if not isinstance(settings, list):
            raise ConfigError("expected tables [[setting]]", path=self._path, key="setting")
        fixed = self._table(data, "mission")
        self._known(fixed, NAMES, "mission.")
        for name, value in fixed.items():
            self._usable(name, value, "mission.")
        return Spec(
            name=self._text(data, "name", self._path.stem),
            about=self._text(data, "about", ""),
            seed=self._count(data, "seed", 1, least=0),
            first_seed=self._count(data, "first_seed", 1, least=0),
            repetitions=self._count(data, "repetitions", 1),
            keep=self._keep(data),
            fixed=fixed,
            axes=self._axes(self._table(data, "factors"), "factors."),
            settings=tuple(self._setting(each, i) for i, each in enumerate(settings)),
            stop=self._stop(data),
            fixed_world=self._fixed_world(data),
        )

    def _setting(self, data: Any, index: int) -> Setting:
        prefix = f"setting[{index}]."
        if not isinstance(data, dict):
            raise ConfigError("expected a table", path=self._path, key=prefix.rstrip("."))
        axes = {name: value for name, value in data.items() if name not in _SETTING}
        count = "repetitions" in data
        return Setting(
            name=self._text(data, "name", ""),
            axes=self._axes(axes, prefix, also=_SETTING),
            repetitions=self._count(data, "repetitions", 1) if count else None,
        )

    def _axes(self, data: Mapping[str, Any], prefix: str, also: tuple[str, ...] = ()) -> Axes:
        self._known(data, (*NAMES, *also), prefix)
        return {name: self._values(name, value, prefix) for name, value in data.items()}

    def _values(self, name: str, value: Any, prefix: str) -> tuple[Any, ...]:
        if name in LISTS:
            several = isinstance(value, list) and any(isinstance(each, list) for each in value)
            values = tuple(value) if several else (value,)
        else:
            values = tuple(value) if isinstance(value, list) else (value,)
        for each in values:
            self._usable(name, each, prefix)
        if name == "planner":  # one planner is one setting, however it is written
            values = tuple(canonical(each) if isinstance(each, str) else each for each in values)
        if name in LISTS:
            return values
        if not values:
            raise ConfigError("an empty list of values", path=self._path, key=f"{prefix}{name}")
        if len({repr(each) for each in values}) < len(values):
            raise ConfigError("a value is listed twice", path=self._path, key=f"{prefix}{name}")
        return values

    def _usable(self, name: str, value: Any, prefix: str) -> None:
        """Refuse a value that no mission can have, whatever the factor's type."""
        if name in LISTS and not isinstance(value, list):
            problem = f"expected a list, got {value!r}"
        elif isinstance(value, _NO_VALUES):
            problem = f"no factor is a date or a time, got {value}"
        else:
            return
        raise ConfigError(problem, path=self._path, key=f"{prefix}{name}")

    def _known(self, data: Mapping[str, Any], names: tuple[str, ...], prefix: str) -> None:
        for key in data:
            if key not in names:
                raise UnknownKey(f"{prefix}{key}", names, path=self._path)

    def _table(self, data: Mapping[str, Any], key: str) -> dict[str, Any]:
        value = data.get(key, {})
        if not isinstance(value, dict):
            raise ConfigError("expected a table", path=self._path, key=key)
        return value

    def _text(self, data: Mapping[str, Any], key: str, default: str) -> str:
        value = data.get(key, default)
        if not isinstance(value, str):
            raise ConfigError(f"expected a text, got {value!r}", path=self._path, key=key)
        return value

    def _count(self, data: Mapping[str, Any], key: str, default: int, least: int = 1) -> int:
        value = data.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ConfigError(
                f"expected a whole number from {least}, got {value!r}", path=self._path, key=key
            )
        return value

    def _keep(self, data: Mapping[str, Any]) -> Keep:
        name = data.get("keep", Keep.FAILURES.value)
        try:
            return Keep(name)
        except ValueError:
            raise UnknownName(
                "policy of keeping runs", str(name), [k.value for k in Keep]
            ) from None

    def _stop(self, data: Mapping[str, Any]) -> Stop | None:
        if "stop" not in data:
            return None
        stop = structure(self._table(data, "stop"), Stop, path=self._path)
        if not (0.0 < stop.margin < 0.5 and 0.0 < stop.confidence < 1.0 and stop.batch >= 1):
            raise ConfigError(
                "needs a margin between 0 and 0.5, a confidence between 0 and 1, a batch from 1",
                path=self._path,
                key="stop",
            )
        return stop

    def _fixed_world(self, data: Mapping[str, Any]) -> FixedWorld | None:
        if "fixed_world" not in data:
            return None
        table = self._table(data, "fixed_world")
        return structure({"fixed_world": table}, _Rule, path=self._path).fixed_world


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rule:
    """Wraps the table, so that errors name it."""

    fixed_world: FixedWorld
