"""The factors of a campaign: what may differ between missions, and the field that holds it.

A new factor is one line in the table: its name in a specification, and the record that has it as a
field.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from enum import Enum
from typing import Any

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, nearest
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.instruction import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig


class _Level(Enum):
    """The level at which faults strike."""

    SOURCE = "source"
    INSTRUCTION = "instruction"


_RECORDS = {_Level.SOURCE: FaultConfig, _Level.INSTRUCTION: InstructionConfig}
# Other names in a specification for fields of the mission and of either level's fault.
_ALIASES = {"stage": "target", "site": "target"}
_NESTED = {"fault", "instruction", "detector"}  # written flat: see below
_NEVER = {"link", "realtime"}  # campaigns fly the simulated vehicle
# Factors that may differ without any fault.
MISSION = tuple(each.name for each in fields(MissionConfig) if each.name not in _NESTED | _NEVER)
_DETECTOR = {"detector": "name"} | {
    each.name: each.name for each in fields(DetectorConfig) if each.name != "name"
}
_FAULT = {
    level: tuple(each.name for each in fields(record) if each.name != "seed")
    for level, record in _RECORDS.items()
}


def _names() -> tuple[str, ...]:
    fault = dict.fromkeys((*_ALIASES, "level", *_FAULT[_Level.SOURCE], *_FAULT[_Level.INSTRUCTION]))
    return (*MISSION, *_DETECTOR, *(name for name in fault if name != "target"))


NAMES = _names()


def target_of(values: Mapping[str, Any]) -> str:
    """The target of the fault in a combination of factors; empty without a fault."""
    return next((str(values[name]) for name in _ALIASES if name in values), "")


def mission_of(values: Mapping[str, Any], seed: int, fault_seed: int) -> MissionConfig:
    """The mission of a combination of factors.

    Raises:
        ConfigError: factors contradict each other, or a value has the wrong type.
    """
    mission = {name: values[name] for name in MISSION if name in values}
    mission["seed"] = values.get("seed", seed)
    mission |= _fault(values, fault_seed)
    detector = {_DETECTOR[name]: value for name, value in values.items() if name in _DETECTOR}
    if detector and "name" not in detector:
        raise ConfigError(f"{', '.join(sorted(detector))}: without a detector")
    if detector and detector["name"] != "none":
        mission["detector"] = detector
    return structure(mission, MissionConfig)


def _fault(values: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """The field `fault` or `instruction` of the mission; empty without a fault."""
    asked = {name: each for name, each in values.items() if name not in (*MISSION, *_DETECTOR)}
    level = _member(asked.pop("level", _Level.SOURCE.value))
    targets = [name for name in _ALIASES if name in asked]
    if len(targets) > 1:
        raise ConfigError("a fault strikes a stage or a site, not both")
    fault = {_ALIASES[name] if name in targets else name: each for name, each in asked.items()}
    for name in fault:
        if name not in _FAULT[level]:
            raise _no_factor(name, level)
    if targets:
        return {"fault" if level is _Level.SOURCE else "instruction": {**fault, "seed": seed}}
    if asked or "level" in values:
        named = sorted({*asked, *({"level"} & set(values))})
        raise ConfigError(f"{', '.join(named)}: a fault needs a stage or a site")
    return {}


def _no_factor(name: str, level: _Level) -> ConfigError:
    match = nearest(name, (*_ALIASES, *_FAULT[level]))
    hint = f"; did you mean {match!r}?" if match else ""
    return ConfigError(f"no factor of faults at {level.value} level{hint}", key=name)


def _member(name: Any) -> _Level:
    try:
        return _Level(name)
    except ValueError:
        known = " or ".join(level.value for level in _Level)
        raise ConfigError(f"expected {known}, got {name!r}", key="level") from None
