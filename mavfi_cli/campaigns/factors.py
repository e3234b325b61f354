"""The factors of a campaign: what may differ between missions, and the field that holds it.

A new factor is one line in the table: its name in a specification, and the record that has it as a
field.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, FaultSpecError, nearest
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One combination of factors: a mission without its seeds."""

    values: Mapping[str, Any]

    @property
    def target(self) -> str:
        """The target of the fault; empty without a fault."""
        return next((str(self.values[name]) for name in _ALIASES if name in self.values), "")

    def mission(self, seed: int, fault_seed: int) -> MissionConfig:
        """The mission.

        Raises:
            ConfigError: factors contradict each other, or a value has the wrong type.
        """
        mission = {name: self.values[name] for name in MISSION if name in self.values}
        mission["seed"] = self.values.get("seed", seed)
        fault = self._fault(fault_seed)
        if fault:
            level, values = fault
            mission["fault" if level is _Level.SOURCE else "instruction"] = values
        detector = {_DETECTOR[name]: value for name, value in self.values.items()
                    if name in _DETECTOR}  # fmt: skip
        if detector and "name" not in detector:
            raise ConfigError(f"{', '.join(sorted(detector))}: without a detector")
        if detector and detector["name"] != "none":
            mission["detector"] = detector
        return structure(mission, MissionConfig)

    def _fault(self, seed: int) -> tuple[_Level, dict[str, Any]] | None:
        elsewhere = {*MISSION, *_DETECTOR}
        asked = {name: value for name, value in self.values.items() if name not in elsewhere}
        level_name = asked.pop("level", _Level.SOURCE.value)
        targets = [name for name in _ALIASES if name in asked]
        level = _member(level_name)
        if not targets:
            for name in asked:
                if name not in _FAULT[level]:
                    raise _no_factor(name, level)
            if asked or "level" in self.values:
                named = sorted({*asked, *({"level"} & set(self.values))})
                raise ConfigError(f"{', '.join(named)}: a fault needs a stage or a site")
            return None
        if len(targets) > 1:
            raise ConfigError("a fault strikes a stage or a site, not both")
        values = {_ALIASES.get(name, name): value for name, value in asked.items()}
        for name in values:
            if name not in _FAULT[level]:
                raise _no_factor(name, level)
        return level, {**values, "seed": seed}


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


def check_names(config: MissionConfig, simulator: Callable[[MissionConfig], None]) -> None:
    """Raise now what would keep every mission like this one from being flown.

    Args:
        config: one of these missions.
        simulator: raises the simulated vehicle's error for the mission, if there is one.

    Raises:
        MavfiError: a world, vehicle, planner, platform, stack or target does not exist; a model is
            for another stack; values make no fault; or the start is blocked.
    """
    from mavfi_cli.autonomy import planners
    from mavfi_cli.spec.detector import detector_of
    from mavfi_cli.spec.platform import load_platform
    from mavfi_cli.spec.stack import load_stack

    planners.find(config.planner)
    load_platform(config.platform)
    load_stack(config.stack)
    if config.fault is not None:
        config.fault.check()
    if config.instruction is not None:
        config.instruction.strategy()
        config.instruction.node()
    if config.detector is not None:
        detector_of(config.detector, config.stack)
    elif config.fault is not None and config.fault.attacks_detector:
        raise FaultSpecError("a fault in the detector needs one")
    simulator(config)
