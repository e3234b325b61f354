"""Specifications as TOML: campaign.toml, the presets, and changes by `--set`."""

from __future__ import annotations

import datetime
import hashlib
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from mavfi_cli.autonomy import canonical_planner
from mavfi_cli.campaigns.specification import LISTS, MISSION, NAMES, Axes, Keep, Spec
from mavfi_cli.core.config import (
    Shipped,
    parse_toml,
    read_text,
    structure,
)
from mavfi_cli.core.errors import ConfigError, named_member

_PRESETS = Shipped("campaign", Path(__file__).parent / "presets")
_FACTORS = ("mission", "factors", "setting")  # tables of factors
_TOP = (*(each.name for each in fields(Spec) if each.name not in ("fixed", "axes", "settings")),
        *_FACTORS)  # fmt: skip
_SETTING = ("name", "repetitions")


def presets() -> tuple[str, ...]:
    """The names of the campaigns that come with mavfi."""
    return tuple(_PRESETS.names)


def load_spec(name: str) -> Spec:
    """Load a preset, or the specification in a TOML file.

    Raises:
        UnknownName: neither a preset nor a file.
        ConfigError: the file cannot be used; says where and why.
    """
    path = _PRESETS.path(name)
    return parse_spec(read_text(path), path if path == Path(name) else Path(path.name))


def parse_spec(text: str, path: Path) -> Spec:
    """Parse a specification in TOML; `path` is for messages and the default name."""
    return _read_spec(parse_toml(text, path), path, text)


def _read_spec(data: Mapping[str, Any], path: Path, text: str = "") -> Spec:
    """Read a specification from TOML's tables; `path` as for `parse_spec`, `text` for lines."""
    read = _Reader(path)
    read.known(data, _TOP, "")
    values: dict[str, Any] = {
        "name": path.stem,
        **{name: value for name, value in data.items() if name not in _FACTORS},
        "fixed": read.fixed(read.table(data.get("mission", {}), "mission")),
        "axes": read.axes(read.table(data.get("factors", {}), "factors"), "factors."),
        "settings": read.settings(data.get("setting", [{}])),
    }
    if "keep" in values:
        values["keep"] = named_member(Keep, "policy of keeping runs", str(values["keep"]))
    return structure(values, Spec, path=path, text=text)


class _Reader:
    """Reads the tables of factors of one file; its errors name the table."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def settings(self, tables: Any) -> list[dict[str, Any]]:
        """Read the tables [[setting]]."""
        if not isinstance(tables, list):
            raise self._error("expected tables [[setting]]", "setting")
        found = []
        for number, each in enumerate(tables):
            place = f"setting[{number}]"
            table = self.table(each, place)
            axes = {name: value for name, value in table.items() if name not in _SETTING}
            own = {name: value for name, value in table.items() if name in _SETTING}
            found.append({**own, "axes": self.axes(axes, f"{place}.", also=_SETTING)})
        return found

    def fixed(self, table: dict[str, Any]) -> dict[str, Any]:
        """Read factors that all missions share."""
        self.known(table, NAMES, "mission.")
        for name, value in table.items():
            self._require_usable(name, value, "mission.")
        return table

    def axes(self, data: Mapping[str, Any], prefix: str, also: tuple[str, ...] = ()) -> Axes:
        """Read factors, each with its value or values."""
        self.known(data, (*NAMES, *also), prefix)
        return {name: self._values(name, value, prefix) for name, value in data.items()}

    def _values(self, name: str, value: Any, prefix: str) -> tuple[Any, ...]:
        several = isinstance(value, list)
        if name in LISTS:
            several = several and any(isinstance(each, list) for each in value)
        values = tuple(value) if several else (value,)
        for each in values:
            self._require_usable(name, each, prefix)
        if name in LISTS:
            return values
        if name == "planner":  # one planner is one setting, however it is written
            values = tuple(
                canonical_planner(each) if isinstance(each, str) else each for each in values
            )
        if not values:
            raise self._error("an empty list of values", f"{prefix}{name}")
        if len({repr(each) for each in values}) < len(values):
            raise self._error("a value is listed twice", f"{prefix}{name}")
        return values

    def _require_usable(self, name: str, value: Any, prefix: str) -> None:
        """Refuse a value that no mission can have, whatever the factor's type."""
        if name in LISTS and not isinstance(value, list):
            raise self._error(f"expected a list, got {value!r}", f"{prefix}{name}")
        if isinstance(value, datetime.date | datetime.time):
            raise self._error(f"no factor is a date or a time, got {value}", f"{prefix}{name}")

    def known(self, data: Mapping[str, Any], names: tuple[str, ...], prefix: str) -> None:
        """Refuse keys that are not among the names."""
        for key in data:
            if key not in names:
                raise ConfigError.unknown_key(f"{prefix}{key}", names, path=self._path)

    def table(self, value: Any, key: str) -> dict[str, Any]:
        """Require that the value of a key is a table."""
        if not isinstance(value, dict):
            raise self._error("expected a table", key)
        return value

    def _error(self, problem: str, key: str) -> ConfigError:
        return ConfigError(problem, path=self._path, key=key)


_ODD = re.compile(r"[^\w.+=-]+")  # not in a folder's name
_COMMA = re.compile(r',(?=(?:[^"]*"[^"]*")*[^"]*$)')  # outside double quotes
_LONGEST = 100  # characters of a folder's name; a longer one ends with a digest of the changes


def replaced(spec: Spec, changes: Sequence[str]) -> Spec:
    """Return the specification with factors replaced, under a name that includes the changes.

    A factor is replaced in all settings that have it. A factor of the mission that is
    missing from the specification is added to all missions.

    Args:
        changes: KEY=VALUE[,VALUE], each with a different key. A value with a comma is quoted
            as in TOML, and all values may be written as one TOML list.

    Raises:
        ConfigError: no such factor; names the nearest.
        ConfigError: a change is not KEY=VALUE, the specification lacks this factor of faults, or it
            cannot have these values.
    """
    if not changes:
        return spec
    data = tomllib.loads(spec.to_toml())
    seen: set[str] = set()
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or not text:
            raise ConfigError(f"expected KEY=VALUE[,VALUE], got {change!r}", key="set")
        if key in seen:
            raise ConfigError(f"{key} is set twice", key="set")
        seen.add(key)
        _replace(data, key, _values(key, text))
        data["name"] += "-" + folder_name(change)
    if len(data["name"]) > _LONGEST:
        digest = hashlib.sha256("\n".join(changes).encode()).hexdigest()[:8]
        data["name"] = f"{data['name'][: _LONGEST - 9]}-{digest}"
    return _read_spec(data, Path(f"{spec.name}.toml"))


def folder_name(text: str) -> str:
    """The text without the characters that do not belong into a folder's name."""
    return _ODD.sub("-", text).strip("-")


def _replace(data: dict[str, Any], key: str, values: list[Any]) -> None:
    if key not in NAMES:
        raise ConfigError.unknown_key(key, NAMES)
    fixed, crossed = data.setdefault("mission", {}), data.setdefault("factors", {})
    found = [table for table in (crossed, *data["setting"]) if key in table]
    for table in found:
        table[key] = values
    if not found and key not in fixed and (key not in MISSION or key == "seed"):
        known = {name for table in (fixed, crossed, *data["setting"]) for name in table}
        have = ", ".join(sorted(known & set(NAMES))) or "none"
        raise ConfigError(f"the campaign has no such factor to replace; it has {have}", key=key)
    one = not isinstance(values[0], list) if key in LISTS and values else len(values) == 1
    if not found and one:
        fixed[key] = values if key in LISTS else values[0]
    elif not found:
        fixed.pop(key, None)
        crossed[key] = values


def _values(key: str, text: str) -> list[Any]:
    """Parse the values; for a list-valued factor, the elements of one list or several lists."""
    listed = text[0] == "[" and text[-1] == "]"
    if listed and isinstance(values := _value(text), list):
        return values
    several = text[1:-1] if key in LISTS and listed else text
    return [_value(each.strip()) for each in _COMMA.split(several)]


def _value(text: str) -> Any:
    """Parse a number, a truth value, a quoted text or a list as in TOML; else keep the text."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, int | float | str | list) else text
