"""What a user asks to be detected, as plain values that a record can hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.errors import ConfigError, OtherStack, UnknownName
from mavfi_cli.core.types import Stage
from mavfi_cli.detect.base import Detector
from mavfi_cli.detect.fitted import FittedDetector
from mavfi_cli.detect.model import shipped, shipped_stacks
from mavfi_cli.detect.registry import find
from mavfi_cli.detect.watch import ExtendedWatch
from mavfi_cli.mission.stack import lineage, load_stack

STAGES = tuple(stage.value for stage in Stage)
PAPER, EXTENDED = "paper", "extended"  # which states are watched
WATCHES = (PAPER, EXTENDED)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorConfig:
    """The detector of a mission.

    Attributes:
        name: gad, aad, range, l2, or a plug-in's name.
        protect: the stages whose states are watched.
        threshold: replaces the model's own; for gad the number of sigmas.
        model: path of a model file; None takes the one that is shipped for the mission's stack.
        alarms_max: the alarm in a row of one stage at which the vehicle holds and plans anew.
        any_stack: a model of another stack than the mission's will do.
        watch: `paper`, the 13 states; `extended` adds those of `detect.watch`.
    """

    name: str
    protect: tuple[str, ...] = STAGES
    threshold: float | None = None
    model: str | None = None
    alarms_max: int = 5
    any_stack: bool = False
    watch: str = PAPER

    def __post_init__(self) -> None:
        if not self.protect:
            raise ConfigError("names no stage", key="protect")
        for stage in self.protect:
            if stage not in STAGES:
                raise UnknownName("stage", stage, STAGES)
        if self.threshold is not None and not (
            math.isfinite(self.threshold) and self.threshold > 0.0
        ):
            raise ConfigError(f"must be above 0, got {self.threshold:g}", key="threshold")
        if not 1 <= self.alarms_max <= 1000:
            raise ConfigError(f"must be within 1 and 1000, got {self.alarms_max}", key="alarms_max")
        if self.watch not in WATCHES:
            raise UnknownName("watch", self.watch, WATCHES)


def model_path(config: DetectorConfig, stack: str) -> Path | None:
    """The model file of a mission's detector; None if it has no model.

    The file is the one that is asked for, else the one that is shipped for the stack or for the
    nearest stack that it is based on. `detector_of` refuses the latter without `any_stack`.

    Args:
        stack: of the mission, as `load_stack` takes it; raises as that does.
    """
    if config.model is not None:
        return Path(config.model)
    for each in lineage(load_stack(stack)):
        if each.name in shipped_stacks() and (path := shipped(config.name, each.name)).is_file():
            return path
    return None


def detector_of(config: DetectorConfig, stack: str) -> Detector:
    """A fresh detector for a mission that flies the stack.

    Args:
        stack: as `load_stack` takes it; raises as that does.

    Raises:
        UnknownName: there is no such detector; names the nearest.
        OtherStack: its model is that of another stack, and `any_stack` was not asked for.
        ModelError: its model cannot be used.
        ConfigError: a threshold out of range; extended states without ranges.
    """
    path = model_path(config, stack)
    detector = find(config.name, model=path, threshold=config.threshold)
    made_for = detector.stack if isinstance(detector, FittedDetector) else None
    if made_for is not None and not config.any_stack:
        flown = load_stack(stack).mark
        if made_for.digest != flown.digest:
            other = f"{made_for.name} as it was" if made_for.name == flown.name else made_for.name
            raise OtherStack(config.name, made_for=other, flown=stack, path=path)
    watch_of(config, detector)
    return detector


def watch_of(config: DetectorConfig, detector: Detector) -> ExtendedWatch | None:
    """What judges the extended states, by the ranges of the detector's model; None: nobody does.

    Raises:
        ConfigError: the detector has no such ranges.
    """
    if config.watch == PAPER:
        return None
    ranges = detector.extended if isinstance(detector, FittedDetector) else None
    if ranges is None:
        raise ConfigError(
            f"{EXTENDED} needs the ranges of a model, and {config.name} has none", key="watch"
        )
    return ExtendedWatch(ranges)
