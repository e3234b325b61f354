"""What a detector is. Ours and those of other packages fulfil the same small protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from mavfi_cli.core.types import Stage
from mavfi_cli.detect.preprocess import Codes


@dataclass(frozen=True, slots=True, kw_only=True)
class StackMark:
    """The companion's stack, as far as detection knows one: flights of another may look otherwise.

    Attributes:
        name: what people call it.
        digest: SHA-256 of its settings; equal digests mean equal stacks.
    """

    name: str
    digest: str


class Detector(Protocol):
    """Judges deltas (COUNT,) int16 in the order of `preprocess.NAMES`; 0 is "no change".

    Attributes:
        name: what it is registered as.
        per_stage: True where each stage is judged alone, and an alarm recomputes that stage.
            False where one score is taken over the whole vector; an alarm recomputes control.
    """

    name: str
    per_stage: bool

    @property
    def threshold(self) -> float:
        """A score above it, or one that is NaN, is an alarm."""

    @property
    def memory(self) -> Mapping[str, NDArray[Any]]:
        """All that decides, the threshold included, as arrays whose change takes effect."""

    def score(self, deltas: Codes, stage: Stage) -> float:
        """How anomalous a sample is.

        Args:
            deltas: changes of all states; those of states without a new sample are 0.
            stage: whose states are judged (per stage), or whose message it is (over all).
        """

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Take an accepted sample into the model; nothing to do for a fixed one."""


class Factory(Protocol):
    """Makes a detector: what an entry point in the group `mavfi.detectors` names."""

    def __call__(self, *, model: Path | None = None, threshold: float | None = None) -> Detector:
        """A fresh detector.

        Args:
            model: its artefact; None takes the default, shipped with the package.
            threshold: replaces the model's own; the number of sigmas, for a Gaussian one.

        Raises:
            ModelError: an artefact that cannot be used.
            ConfigError: a threshold out of range.
        """
