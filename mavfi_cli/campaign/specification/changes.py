"""A specification with other values of some factors, as `--set KEY=VALUE[,VALUE]` asks for."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.specification.factors import MISSION, NAMES
from mavfi_cli.campaign.specification.spec import LISTS, Spec, read_spec
from mavfi_cli.campaign.specification.text import to_toml
from mavfi_cli.core.errors import ConfigError, UnknownKey

_ODD = re.compile(r"[^\w.+=-]+")  # what no folder's name gets


def replaced(spec: Spec, changes: Sequence[str]) -> Spec:
    """The specification with factors replaced, under a name that tells them.

    A factor is replaced wherever the specification has it, in all settings; one of the mission that
    it does not have is added to all missions.

    Args:
        changes: KEY=VALUE[,VALUE], each another key.

    Raises:
        UnknownKey: no such factor; names the nearest.
        ConfigError: no KEY=VALUE, a factor of faults that the specification has not, or values
            that a specification cannot have.
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
        data["name"] += "-" + _ODD.sub("-", change)
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
    if not found and (len(values) == 1 or key in LISTS):
        fixed[key] = values if key in LISTS else values[0]
    elif not found:
        fixed.pop(key, None)
        crossed[key] = values


def _values(key: str, text: str) -> list[Any]:
    """The values; of a factor that is a list, the elements of one."""
    several = text[1:-1] if key in LISTS and text[0] == "[" and text[-1] == "]" else text
    return [_value(each.strip()) for each in several.split(",")]


def _value(text: str) -> Any:
    """A number or truth value as in TOML; else the text."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, int | float | str) else text
