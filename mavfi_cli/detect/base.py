"""Interface of our detectors and those of other packages, found by their entry points."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from mavfi_cli.core.installed import installed, load_plug_in
from mavfi_cli.core.types import Stage
from mavfi_cli.detect.preprocess import Codes


class Detector(Protocol):
    """Scores deltas (COUNT,) int16 in the order of `preprocess.NAMES`; 0 means no change.

    Attributes:
        per_stage: True if each stage is scored alone and an alarm recomputes that stage. False if
            one score covers the whole vector and an alarm recomputes control.
    """

    name: str
    per_stage: bool

    @property
    def threshold(self) -> float:
        """Threshold. A score above it, or a NaN score, raises an alarm."""

    @property
    def memory(self) -> Mapping[str, NDArray[Any]]:
        """All state of the detector, including the threshold, as writable arrays."""

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the anomaly score of a sample.

        Args:
            deltas: Deltas of all states; 0 for states without a new sample.
            stage: Stage to score (per stage), or stage of the message (one score over all).
        """

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Update the model with an accepted sample. A fixed model does nothing."""


# An entry point of this group names a function that creates a detector. It takes the arguments of
# `find_detector` but the name.
ENTRY_POINT_GROUP = "mavfi.detectors"


def detector_names() -> list[str]:
    """Return the names of all installed detectors, sorted."""
    return sorted(installed(ENTRY_POINT_GROUP).names)


def find_detector(
    name: str, *, model: Path | None = None, threshold: float | None = None
) -> Detector:
    """Create a new detector of that name.

    Args:
        model: Model file; None selects the shipped one.
        threshold: Replaces the model's threshold; a number of sigmas for `gad`.

    Raises:
        UnknownName: No detector has this name. Suggests the nearest.
        MavfiError: Its package does not load.
        ModelError: The model file cannot be used.
        ConfigError: The threshold is out of range.
    """
    factory = load_plug_in(ENTRY_POINT_GROUP, "detector", name, detector_names())
    detector: Detector = factory(model=model, threshold=threshold)
    return detector
