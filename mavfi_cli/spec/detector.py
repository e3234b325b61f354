"""Configuration of a mission's detector, as plain values for the record."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mavfi_cli.core.errors import ConfigError, ModelError, UnknownName
from mavfi_cli.core.files import file_digest
from mavfi_cli.core.types import StackMark, Stage
from mavfi_cli.spec.stack import load_stack

if TYPE_CHECKING:
    from mavfi_cli.detect.base import Detector
    from mavfi_cli.detect.preprocess import Ranges

STAGES = tuple(stage.value for stage in Stage)
PAPER, EXTENDED = "paper", "extended"  # sets of watched states
WATCHES = (PAPER, EXTENDED)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorConfig:
    """The detector of a mission: its model, its threshold and the states that it watches.

    Attributes:
        name: gad, aad, range, l2 or the name of a plug-in.
        protect: Stages whose states are watched.
        threshold: Threshold that replaces the model's; for gad, a number of sigmas.
        model: Path of a model file; None selects the one shipped for the mission's stack.
        alarms_max: Number of consecutive alarms in planning or control after which the vehicle
            holds and replans; also the maximum number of consecutive reports that are withheld.
        any_stack: Allow a model that was fitted to another stack.
        watch: Watched states: `paper` for the paper's 13 states, `extended` for three more.
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
            raise ConfigError("must name at least one stage", key="protect")
        for stage in self.protect:
            if stage not in STAGES:
                raise UnknownName("stage", stage, STAGES)
        if self.threshold is not None and not (
            math.isfinite(self.threshold) and self.threshold > 0.0
        ):
            raise ConfigError(
                f"must be a finite number above 0, got {self.threshold:g}", key="threshold"
            )
        if not 1 <= self.alarms_max <= 1000:
            raise ConfigError(
                f"must be between 1 and 1000, got {self.alarms_max}", key="alarms_max"
            )
        if self.watch not in WATCHES:
            raise UnknownName("watch", self.watch, WATCHES)

    @classmethod
    def with_model(
        cls, name: str, models: Path | None, protect: tuple[str, ...] = STAGES
    ) -> DetectorConfig:
        """Configure the detector `name` with the model file NAME.json in the folder `models`.

        If `models` is None, the detector uses the model shipped for the mission's stack.

        Raises:
            ModelError: The folder does not contain NAME.json.
        """
        path = None if models is None else models.absolute() / f"{name}.json"
        if path is not None and not path.is_file():
            raise ModelError("no such model file", path=path)
        return cls(name=name, protect=protect, model=None if path is None else str(path))

    def model_path(self, stack: str) -> Path | None:
        """Return the path of the model file, or None if the detector has no model.

        The file is the configured one, or else the one shipped for the stack or for its nearest
        base stack. `build` rejects the model of a base stack unless `any_stack` is set.

        Args:
            stack: Stack of the mission, as for `load_stack`, whose errors are raised too.
        """
        from mavfi_cli.detect.base import shipped

        if self.model is not None:
            return Path(self.model)
        while stack:
            flown = load_stack(stack)
            if (path := shipped(self.name, flown.name)).is_file():
                return path
            stack = flown.base
        return None

    def model_digest(self, stack: str) -> str:
        """Return the digest of the model file, or "none" if the detector has no model.

        Raises the same errors as `model_path`.
        """
        path = self.model_path(stack)
        return "none" if path is None else file_digest(path)

    def build(self, stack: str) -> Detector:
        """Create a new detector for a mission with the given stack.

        Args:
            stack: Stack of the mission, as for `load_stack`, whose errors are raised too.

        Raises:
            UnknownName: No detector has this name. The message suggests the nearest.
            ModelError: The model cannot be used, or is for another stack and `any_stack` is false.
            ConfigError: The threshold is out of range, or the model lacks ranges of extended
                states.
        """
        from mavfi_cli.detect.base import FittedDetector, find_detector

        path = self.model_path(stack)
        detector = find_detector(self.name, model=path, threshold=self.threshold)
        made_for = detector.stack if isinstance(detector, FittedDetector) else None
        if made_for is not None and not self.any_stack:
            flown = load_stack(stack).mark
            if made_for.digest != flown.digest:
                same = made_for.name == flown.name
                of = (
                    f"another version of the stack {stack!r}"
                    if same
                    else (f"the stack {made_for.name!r}, not for {stack!r}")
                )
                raise ModelError(
                    f"{self.name}: this model was fitted for {of}; fit a new one with "
                    f"mavfi train --stack {shlex.quote(stack)}, or allow this one with "
                    "--any-stack-model (any_stack in a campaign)",
                    path=path,
                )
        self.extended_ranges(detector)
        return detector

    def build_for_companion(self, mark: StackMark | None) -> Detector:
        """Create a new detector for the gate of a user's companion.

        Args:
            mark: Identity of the companion; None accepts a model of any companion.

        Raises:
            UnknownName: No detector has this name.
            ModelError: The model cannot be used, is missing, or is for another companion and
                `any_stack` is false.
        """
        from mavfi_cli.detect.base import FittedDetector, find_detector

        path = None if self.model is None else Path(self.model)
        detector = find_detector(self.name, model=path, threshold=self.threshold)
        made_for = detector.stack if isinstance(detector, FittedDetector) else None
        if made_for is None or self.any_stack:
            return detector
        fit = "fit one with mavfi train --companion, from new flights or with --from"
        if path is None:
            problem = f"{self.name} needs --model, a model fitted to the companion; {fit}"
            raise ModelError(problem).as_usage()
        if not made_for.is_companion:
            raise ModelError(
                f"this model was fitted to the stack {made_for.name!r}, not to a companion; {fit}",
                path=path,
            )
        if mark is not None and mark.digest != made_for.digest:
            raise ModelError(
                f"this model was fitted to {made_for.name!r}, not to {mark.name!r} with its "
                f"present commands; {fit}, or allow this model with --any-stack-model (mavfi gate: "
                "leave out --companion)",
                path=path,
            )
        return detector

    def extended_ranges(self, detector: Detector) -> Ranges | None:
        """Return the model's ranges of the extended states, or None if they are not watched.

        Raises:
            ConfigError: The model lacks ranges of the extended states.
        """
        from mavfi_cli.detect.base import FittedDetector

        if self.watch == PAPER:
            return None
        ranges = detector.extended if isinstance(detector, FittedDetector) else None
        if ranges is None:
            raise ConfigError(
                f"{EXTENDED} needs the state ranges of a fitted model, but {self.name} has none",
                key="watch",
            )
        return ranges
