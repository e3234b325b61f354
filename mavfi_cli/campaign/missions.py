"""The missions of a campaign: a numbered list in which each mission is complete by itself."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, MavfiError
from mavfi_cli.spec.mission import MissionConfig

Label = str | int | float | bool | None
_FIRST = ("setting", "world")  # labels that come before the others


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedMission:
    """One mission of a campaign; its number is its place in the list, from 0.

    Attributes:
        config: the mission's configuration.
        labels: the setting that the mission belongs to; missions of equal labels are counted
            together.
        pair: missions of equal pairs share world, start and noise; empty: by `pair_of`.
    """

    config: MissionConfig
    labels: Mapping[str, Label] = field(default_factory=dict)
    pair: str = ""

    def __post_init__(self) -> None:
        if not self.pair:
            object.__setattr__(self, "pair", pair_of(self.config))


_DEFAULT = MissionConfig()
_BASE: Mapping[str, Any] = json.loads(json.dumps(asdict(_DEFAULT)))
# Faults and protection, which a golden run does not have.
_TREATMENT = ("fault", "instruction", "detector", "isolate")


def canonical(value: Any) -> str:
    """Canonical JSON of a value: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def changes_of(config: MissionConfig) -> dict[str, Any]:
    """The values of a mission that differ from the defaults, as plain values."""
    changed = {
        each.name: value
        for each in fields(MissionConfig)
        if (value := getattr(config, each.name)) != getattr(_DEFAULT, each.name)
    }
    plain = json.loads(json.dumps(changed, default=asdict))
    return {name: value for name, value in plain.items() if value != _BASE[name]}


def config_from(changes: Mapping[str, Any]) -> MissionConfig:
    """Make the mission from the result of `changes_of`.

    Raises:
        ConfigError: a key or a value that this version of mavfi does not have.
    """
    return structure(changes, MissionConfig)


def golden_of(config: MissionConfig) -> MissionConfig:
    """The same mission without fault and without protection."""
    bare: dict[str, Any] = {
        each.name: each.default for each in fields(MissionConfig) if each.name in _TREATMENT
    }
    return replace(config, **bare)


def pair_of(config: MissionConfig) -> str:
    """A hash of everything that golden, faulty and protected flights of a pair share."""
    text = canonical(changes_of(golden_of(config)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def label_text(labels: Mapping[str, Any]) -> str:
    """A setting in one phrase; the same whatever the order of its labels."""
    told = (f"{name}={label_value(labels[name])}" for name in ordered(labels))
    return " ".join(told) or "all missions"


def label_value(value: Label) -> str:
    """The value of a label as a specification has it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def ordered(names: Iterable[str]) -> list[str]:
    """Names of labels in the order in which they are shown."""
    found = set(names)
    return [name for name in _FIRST if name in found] + sorted(found - set(_FIRST))


@contextlib.contextmanager
def naming(labels: Mapping[str, Label]) -> Iterator[None]:
    """Make a known error inside name the setting that it concerns.

    Raises:
        ConfigError: instead of any MavfiError.
    """
    try:
        yield
    except MavfiError as error:
        place = f" (in {label_text(labels)})" if labels else ""
        raise ConfigError(f"{error}{place}") from None
