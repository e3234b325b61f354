"""Replaces factors of a specification, as `--set KEY=VALUE[,VALUE]` requests."""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.specification.factors import MISSION, NAMES
from mavfi_cli.campaign.specification.spec import LISTS, Spec, read_spec
from mavfi_cli.campaign.specification.text import to_toml
from mavfi_cli.core.errors import ConfigError, UnknownKey

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
        UnknownKey: no such factor; names the nearest.
        ConfigError: a change is not KEY=VALUE, the specification lacks this factor of faults, or it
            cannot have these values.
    """
    if not changes:
        return spec
    data = tomllib.loads(to_toml(spec))
    seen: set[str] = set()
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or not text:
            raise ConfigError(f"expected KEY=VALUE[,VALUE], got {change!r}", key="set")
        if key in seen:
            raise ConfigError(f"{key} is set twice", key="set")
        seen.add(key)
        _replace(data, key, _values(key, text))
        data["name"] += "-" + _ODD.sub("-", change).strip("-")
    if len(data["name"]) > _LONGEST:
        digest = hashlib.sha256("\n".join(changes).encode()).hexdigest()[:8]
        data["name"] = f"{data['name'][: _LONGEST - 9]}-{digest}"
    return read_spec(data, Path(f"{spec.name}.toml"))


def _replace(data: dict[str, Any], key: str, values: list[Any]) -> None:
    if key not in NAMES:
        raise UnknownKey(key, NAMES)
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
