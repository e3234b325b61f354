"""Reads specifications from TOML (campaign.toml, the presets) and applies `--set` changes."""

from __future__ import annotations

import datetime
import hashlib
import re
import tomllib
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from mavfi_cli.autonomy import canonical_planner
from mavfi_cli.campaigns.missions import Sampling
from mavfi_cli.campaigns.specification import LISTS, MISSION, NAMES, Axes, Factors, Keep, Spec
from mavfi_cli.core.config import (
    Shipped,
    parse_toml,
    read_text,
    read_toml,
    structure,
)
from mavfi_cli.core.errors import ConfigError, UnknownName, named_member
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import LIMITS

PRESETS = Shipped("campaign", Path(__file__).parent / "presets")
_FIXED_WORLDS = Shipped("fixed worlds", Path(__file__).parent / "fixed_worlds")
_FACTORS = ("mission", "factors", "setting")  # tables of factors
_TOP = (*(key.name for key in fields(Spec) if key.name not in ("fixed", "axes", "settings")),
        *_FACTORS)  # fmt: skip
_SETTING = ("name", "repetitions")
# Factors that only faults at instruction level have.
_OF_INSTRUCTIONS = {key.name for key in fields(InstructionConfig)} - {
    key.name for key in fields(FaultConfig)
}


def load_spec(name: str) -> Spec:
    """Load a preset, or the specification in a TOML file.

    Raises:
        UnknownName: the name is neither a preset nor a file, or `[fixed_world]` names a world
            without missions. A shipped table of fixed worlds may name more than the missions fly.
        ConfigError: the file is invalid.
    """
    path = PRESETS.path(name)
    spec = parse_spec(read_text(path), path if path == Path(name) else Path(path.name))
    if spec.fixed_world is not None:
        flown = {mission.config.world for mission in spec.kinds()}
        shipped = (read_toml(_FIXED_WORLDS.path(name))[0] for name in _FIXED_WORLDS.names)
        known = {seed for table in shipped for seed in table["world_seed"].items()}
        own = dict(spec.fixed_world.world_seed.items() - known)
        for world in (*spec.fixed_world.worlds, *sorted(own)):
            if world not in flown:
                raise UnknownName("world of [fixed_world]", world, flown)
    return spec


def parse_spec(text: str, path: Path) -> Spec:
    """Parse a specification from TOML text. `path` appears in errors and gives the default name."""
    return _read_spec(parse_toml(text, path), path, text)


def _read_spec(data: Factors, path: Path, text: str = "") -> Spec:
    """Read a specification from TOML tables. `path` and `text` only serve to locate errors."""
    _require_table(data, "", _TOP, path)
    mission, factors = data.get("mission", {}), data.get("factors", {})
    settings = data.get("setting", [{}])
    if not isinstance(settings, list):
        raise ConfigError("must be one or more [[setting]] tables", path=path, key="setting")
    _require_table(mission, "mission", NAMES, path)
    for name, value in mission.items():
        _require_usable(name, value, f"mission.{name}", path)
    _require_table(factors, "factors", NAMES, path)
    axes_of_settings = []
    for number, table in enumerate(settings):
        place = f"setting[{number}]"
        _require_table(table, place, (*NAMES, *_SETTING), path)
        own = {name: table[name] for name in _SETTING if name in table}
        rest = {name: value for name, value in table.items() if name not in own}
        axes_of_settings.append({**own, "axes": _axes(rest, place, path)})
    values: dict[str, Any] = {
        "name": path.stem,
        **{name: value for name, value in data.items() if name not in _FACTORS},
        "fixed": {name: _meant(name, value) for name, value in mission.items()},
        "axes": _axes(factors, "factors", path),
        "settings": axes_of_settings,
    }
    if isinstance(name := values.get("fixed_world"), str):
        if name not in _FIXED_WORLDS.names:
            error = UnknownName(_FIXED_WORLDS.kind, name, _FIXED_WORLDS.names)
            raise ConfigError(str(error), path=path, key="fixed_world")
        values["fixed_world"], _ = read_toml(_FIXED_WORLDS.path(name))
    if "keep" in values:
        values["keep"] = named_member(Keep, "policy of keeping runs", str(values["keep"]))
    if "sampling" in values:
        values["sampling"] = named_member(Sampling, "sampling", str(values["sampling"]))
    return structure(values, Spec, path=path, text=text)


def _require_table(table: Any, key: str, known: Sequence[str], path: Path) -> None:
    if not isinstance(table, dict):
        raise ConfigError(f"must be a table, got {table!r}", path=path, key=key)
    for name in table:
        if name not in known:
            place = f"{key}.{name}" if key else name
            raise ConfigError.unknown_key(place, tuple(known), path=path)


def _require_usable(name: str, value: Any, key: str, path: Path) -> None:
    """Raise ConfigError for a date or time, or if a list-valued factor has no list."""
    if name in LISTS and not isinstance(value, list):
        raise ConfigError(f"must be a list, got {value!r}", path=path, key=key)
    if isinstance(value, datetime.date | datetime.time):
        raise ConfigError(f"must not be a date or a time, got {value}", path=path, key=key)


def _axes(table: Factors, place: str, path: Path) -> Axes:
    """Return the values of each factor in a table. A single value becomes a tuple of one."""
    axes: dict[str, tuple[Any, ...]] = {}
    for name, value in table.items():
        key, several = f"{place}.{name}", isinstance(value, list)
        if name in LISTS:
            several = several and any(isinstance(item, list) for item in value)
        given = value if several else [value]
        for item in given:
            _require_usable(name, item, key, path)
        values = tuple(_meant(name, item) for item in given)  # two spellings count as one value
        if name not in LISTS and not values:
            raise ConfigError("must have at least one value, got []", path=path, key=key)
        if name not in LISTS and len(set(map(repr, values))) < len(values):
            raise ConfigError(f"must not list a value twice, got {[*values]}", path=path, key=key)
        axes[name] = values
    return axes


def _meant(name: str, value: Any) -> Any:
    """Return a factor's value without other spellings: names of a planner, and `never`."""
    if name == "planner" and isinstance(value, str):
        return canonical_planner(value)
    return LIMITS[name][1] if (name, value) == ("node_restart_s", "never") else value


_ODD = re.compile(r"[^\w.+=-]+")  # unsuitable for a folder's name
_COMMA = re.compile(r',(?=(?:[^"]*"[^"]*")*[^"]*$)')  # outside double quotes
_LONGEST = 100  # characters of a folder's name; the end of a longer one becomes a digest


def replaced(spec: Spec, changes: Sequence[str]) -> Spec:
    """Return the specification with the given changes to factors, which are added to its name.

    A factor is replaced in all settings that have it. A mission factor that the specification
    lacks is added to all missions. A factor of instruction-level faults, such as `compat`, is
    added to the settings at that level.

    Args:
        changes: KEY=VALUE[,VALUE] with distinct keys. A value with a comma is quoted as in TOML,
            and all values may be written as one TOML list.

    Raises:
        ConfigError: a change is not KEY=VALUE, its key is not a factor or is a fault's factor that
            the specification lacks, or its values are invalid.
    """
    if not changes:
        return spec
    data = tomllib.loads(spec.to_toml())
    seen: set[str] = set()
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or not text:
            raise ConfigError(f"must be KEY=VALUE[,VALUE], got {change!r}", key="set")
        if key in seen:
            raise ConfigError(f"{key} is set twice", key="set")
        seen.add(key)
        try:
            _replace(data, key, _values(key, text))
        except ConfigError as error:
            raise ConfigError(str(error), key="set") from None
        data["name"] += "-" + folder_name(change)
    if len(data["name"]) > _LONGEST:
        digest = hashlib.sha256("\n".join(changes).encode()).hexdigest()[:8]
        data["name"] = f"{data['name'][: _LONGEST - 9]}-{digest}"
    return _read_spec(data, Path(f"{spec.name}.toml"))


def folder_name(text: str) -> str:
    """Replace characters that are unsuitable for a folder's name by hyphens."""
    return _ODD.sub("-", text).strip("-")


def _replace(data: dict[str, Any], key: str, values: list[Any]) -> None:
    if key not in NAMES:
        raise ConfigError.unknown_key(key, NAMES)
    fixed, crossed = data.setdefault("mission", {}), data.setdefault("factors", {})
    tables = [table for table in (crossed, *data["setting"]) if key in table]
    if not tables and key in _OF_INSTRUCTIONS:
        tables = [table for table in data["setting"] if "instruction" in table.get("level", ())]
    for table in tables:
        table[key] = values
    if not tables and key not in fixed and (key not in MISSION or key == "seed"):
        known = {name for table in (fixed, crossed, *data["setting"]) for name in table}
        have = ", ".join(sorted(known & set(NAMES))) or "none"
        raise ConfigError(
            f"cannot be set, because it is not a factor of this campaign; its factors: {have}",
            key=key,
        )
    one = not isinstance(values[0], list) if key in LISTS and values else len(values) == 1
    if not tables and one:
        fixed[key] = values if key in LISTS else values[0]
    elif not tables:
        fixed.pop(key, None)
        crossed[key] = values


def _values(key: str, text: str) -> list[Any]:
    """Parse values separated by commas, or written as one list; see `replaced`."""
    listed = text[0] == "[" and text[-1] == "]"
    if listed and isinstance(values := _value(text), list):
        return values
    several = text[1:-1] if key in LISTS and listed else text
    return [_value(part.strip()) for part in _COMMA.split(several)]


def _value(text: str) -> Any:
    """Parse a TOML number, boolean, string or array; return any other text unchanged."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, int | float | str | list) else text
