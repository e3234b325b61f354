"""What a user asks to be detected, as plain values that a record can hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.core.types import Stage

STAGES = tuple(stage.value for stage in Stage)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorConfig:
    """The detector of a mission.

    Attributes:
        name: gad, aad, range, l2, or a plug-in's name.
        protect: the stages whose states are watched.
        threshold: replaces the model's own; for gad the number of sigmas.
        model: path of a model file; None takes the one that comes with the detector.
        alarms_max: the alarm in a row of one stage at which the vehicle holds and plans anew.
    """

    name: str
    protect: tuple[str, ...] = STAGES
    threshold: float | None = None
    model: str | None = None
    alarms_max: int = 5

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

    @property
    def model_path(self) -> Path | None:
        """The model file; None for the detector's own."""
        return None if self.model is None else Path(self.model)
