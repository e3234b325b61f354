"""The detector interface, the registry, and the base class and model files of our detectors.

A model file holds a fitted detector and its provenance as JSON. Unknown and missing keys
are errors.

Our detectors keep their state in one flat array. A cheap one scores a whole tick, or a whole plan,
in one compiled call, because a call costs more time than the arithmetic. In flight, where caches
hold other data, a call costs several times more.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, MavfiError, ModelError
from mavfi_cli.core.files import write_json
from mavfi_cli.core.installed import PlugIns
from mavfi_cli.core.types import FloatArray, StackMark, Stage
from mavfi_cli.detect.preprocess import (
    EXTENDED,
    LIMIT,
    STATES_DIGEST,
    Codes,
    PreprocessParams,
    Ranges,
)

SCHEMA = 2
SHIPPED = Path(__file__).parent / "models"  # one folder per stack
DEFAULT_STACK = "mavbench"  # stack of the default models
# An entry point names a function that creates a detector. It takes the arguments of
# `find_detector` except the name.
PLUG_INS = PlugIns("mavfi.detectors", "detector")


class Detector(Protocol):
    """A detector, which scores the changes of the monitored states.

    The changes are deltas: an int16 array of shape (COUNT,) in the order of `preprocess.NAMES`. A
    delta of 0 means no change.

    Attributes:
        per_stage: True if each stage is scored alone and an alarm recomputes that stage. False if
            one score covers the whole vector and an alarm recomputes control.
    """

    name: str
    per_stage: bool

    @property
    def threshold(self) -> float:
        """The threshold. A score above it, or a NaN score, raises an alarm."""

    @property
    def memory(self) -> Mapping[str, NDArray[Any]]:
        """All state of the detector, including the threshold, as writable arrays keyed by name."""

    def score(self, deltas: Codes, stage: Stage) -> float:
        """Return the anomaly score of a sample. A higher score is more anomalous.

        Args:
            deltas: Deltas of all states. They are 0 for states without a new sample.
            stage: Stage to score if `per_stage`, otherwise the stage of the message.
        """

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Update the model with a sample that the gate accepted. A fixed model does nothing."""


def find_detector(
    name: str, *, model: Path | None = None, threshold: float | None = None
) -> Detector:
    """Create a new detector of the kind `name`.

    Args:
        model: Path of a model file; None selects the one shipped for the default stack.
        threshold: Threshold that replaces the model's; for `gad`, a number of sigmas.

    Raises:
        UnknownName: No detector has this name. The message suggests the nearest.
        MavfiError: The package of the detector cannot be loaded.
        ModelError: The model file cannot be used.
        ConfigError: The threshold is out of range.
    """
    detector: Detector = PLUG_INS.load(name)(model=model, threshold=threshold)
    return detector


def checked_threshold(value: float, key: str = "threshold") -> float:
    """Check that a threshold is a finite number above 0, and return it.

    Raises:
        ConfigError: The threshold is not finite or not above 0.
    """
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"must be a finite number above 0, got {value!r}", key=key)
    return float(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """A fitted detector and its provenance: the contents of a model file."""

    schema: int = SCHEMA
    mavfi: str = field(default_factory=lambda: version("mavfi"))
    detector: str  # kind: gad, aad, range or l2
    arrays: dict[str, Any]  # arrays of float64, stored in a file as lists
    stack: StackMark  # stack of the flights it was fitted to
    extended: Ranges  # ranges of the extended states in these flights
    states: str = STATES_DIGEST
    preprocess: PreprocessParams = field(default_factory=PreprocessParams)
    preprocess_digest: str = ""  # empty: that of `preprocess`
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.preprocess_digest:
            object.__setattr__(self, "preprocess_digest", self.preprocess.digest())

    @property
    def training_flights(self) -> list[str]:
        """Names (`world/seed`) of the flights that the model was fitted to, in all its parts.

        The parts are those for training, validation and the threshold.
        """
        parts = self.provenance.get("split", {})
        if not isinstance(parts, Mapping):
            return []
        return [str(flight) for part in parts.values() for flight in part]

    def save(self, path: Path) -> None:
        """Write the model to a file, atomically.

        Raises:
            ModelError: A number is not finite. Nothing is written.
            RecordError: The file could not be written.
        """
        for name, array in self.arrays.items():
            _require_finite(name, array, path)
        write_json(path, asdict(self))

    @classmethod
    def read(cls, path: Path) -> Model:
        """Read the model file of any detector, written by any version with this schema.

        Raises:
            ModelError: The file cannot be read, is corrupt, or has another schema.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ModelError(error.strerror or str(error), path=path) from None
        except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
            raise ModelError("corrupt model file: not JSON", path=path) from None
        if not isinstance(data, dict):
            raise ModelError("corrupt model file: not a JSON object", path=path)
        if (schema := data.get("schema", SCHEMA)) != SCHEMA:
            raise ModelError(f"model schema must be {SCHEMA!r}, got {schema!r}", path=path)
        if odd := set(data) ^ {key.name for key in fields(cls)}:
            raise ModelError(
                f"corrupt model file: missing or unknown keys {', '.join(sorted(odd))}", path=path
            )
        try:
            model = structure(data, cls)
        except ConfigError as error:
            raise ModelError(f"corrupt model file: {error}", path=path) from None
        if asdict(model.preprocess) != data["preprocess"]:
            raise ModelError("corrupt model file: preprocess: parameters are missing", path=path)
        return model

    def incompatibility(self, detector: str, shapes: Mapping[str, tuple[int, ...]]) -> str:
        """Return the reason why `detector` cannot use the model, or an empty string if it can.

        `shapes` are the shapes of the arrays that the detector needs, keyed by name.
        """
        names = [state.name for state in EXTENDED]
        if self.mavfi != version("mavfi"):
            return f"must be made for mavfi {version('mavfi')!r}, got {self.mavfi!r}"
        if self.detector != detector:
            return f"must be made for detector {detector!r}, got {self.detector!r}"
        if self.states != STATES_DIGEST:
            return "made for another table of states; fit a new model with mavfi train"
        if self.preprocess_digest != self.preprocess.digest():
            return "made with another preprocessing; fit a new model with mavfi train"
        if set(self.extended) != set(names):
            return f"corrupt model file: extended must be {', '.join(names)}"
        for name, (low, high) in self.extended.items():
            if not -LIMIT <= low <= 0 <= high <= LIMIT:
                return f"corrupt model file: extended: {name} must be an int16 range including 0"
        if set(self.arrays) != set(shapes):
            return f"corrupt model file: arrays must be {', '.join(shapes)}"
        return ""


def _require_finite(name: str, array: FloatArray, path: Path) -> None:
    if not np.isfinite(array).all():
        raise ModelError(f"array {name!r} must be finite, got NaN or infinity", path=path)


def shipped(detector: str, stack: str = DEFAULT_STACK) -> Path:
    """Return the path of the shipped model of a detector for a stack. The file may not exist."""
    return SHIPPED / stack / f"{detector}.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorListing:
    """One row of `listing`: a detector, and one of its models if it has any."""

    name: str
    model: str | None = None  # path of the model file
    stack: str | None = None
    threshold: float | None = None
    provenance: Mapping[str, Any] | None = None
    description: str  # origin of the model, or the reason why it cannot be used


def listing(models: Path | None = None) -> list[DetectorListing]:
    """Return one row per model of each detector, and one row for a detector without a model.

    Args:
        models: Folder of model files `NAME.json`; None selects the shipped models.
    """
    rows = []
    for name in PLUG_INS.names:
        ours = sorted(SHIPPED.glob(f"*/{name}.json"))
        paths = ours if models is None else [models / f"{name}.json"]
        rows += [_listed(name, path) for path in paths] or [_listed(name, None)]
    return rows


def _listed(name: str, path: Path | None) -> DetectorListing:
    row = DetectorListing(
        name=name,
        model=str(path) if path is not None and path.is_file() else None,
        description="needs no training",
    )
    try:
        row = replace(row, threshold=find_detector(name, model=path).threshold)
        if path is None:
            return row
        model = Model.read(path)
    except MavfiError as error:  # from the model, or from a plug-in that cannot be loaded
        return replace(row, description=f"cannot be used: {error}")
    provenance, flights = model.provenance, model.training_flights
    seeds = sorted({int(end) for f in flights if (end := f.rpartition("/")[2]).isdigit()})
    span = f", seeds {seeds[0]} to {seeds[-1]}" if seeds else ""
    worlds = ", ".join(provenance.get("worlds", [])) or "unknown worlds"
    flown = f"{provenance.get('flights', len(flights))} flights"
    if autopilot := provenance.get("autopilot"):
        flown += f" of {autopilot}"
    return replace(
        row,
        stack=model.stack.name,
        provenance={"mavfi": model.mavfi, "detector": model.detector, **provenance},
        description=f"{flown} in {worlds}{span}; mavfi {model.mavfi}",
    )


Shapes = dict[str, tuple[int, ...]]
# (memory, work, waypoints, row, velocity, yaw, keep_report) -> score, and PASSED or its stage.
TickJudge = Callable[..., tuple[float, int]]
# (memory, work, waypoints, first, steps, changes, scores) -> number of steps.
PlanJudge = Callable[..., int]
PASSED, OF_PLANNING, OF_CONTROL = range(3)  # stage with a score above the threshold


class FittedDetector:
    """Base class of our detectors, which keep all their state in one flat array.

    Attributes:
        flat: The whole memory as one array, which is passed to compiled code.
        shapes: Names and shapes of the arrays in the memory, in order. The first array is the
            threshold, a single number.
        divisors: Arrays, besides the threshold, whose numbers must all be above 0.
        scratch: Number of scratch elements for compiled code, at the end of `flat`.
        stack: Stack of the flights that the model was fitted to; None without a model file.
        extended: Ranges of the extended states in these flights; None without a model file.
        tick_judge: Compiled function that calls `preprocess.take_tick`, then scores and learns as
            the gate does; None if the detector has none.
        plan_judge: Compiled function that calls `preprocess.plan_deltas`, then scores each step
            that this returns; None if the detector has none.
    """

    name: ClassVar[str]
    per_stage: ClassVar[bool]
    shapes: ClassVar[Shapes]
    divisors: ClassVar[tuple[str, ...]] = ()
    scratch: ClassVar[int] = 0
    tick_judge: ClassVar[TickJudge | None] = None
    plan_judge: ClassVar[PlanJudge | None] = None

    def __init__(self, arrays: Mapping[str, FloatArray]) -> None:
        pieces = [np.asarray(arrays[name], np.float64).ravel() for name in self.shapes]
        self.flat: FloatArray = np.concatenate([*pieces, np.zeros(self.scratch)])
        self.stack: StackMark | None = None
        self.extended: Ranges | None = None

    @property
    def memory(self) -> Mapping[str, FloatArray]:
        """Writable views of the detector's state, keyed by name.

        A change takes effect at the next sample.
        """
        views, start = {}, 0
        for name, shape in self.shapes.items():
            end = start + math.prod(shape)
            views[name] = self.flat[start:end].reshape(shape)
            start = end
        return views

    @property
    def threshold(self) -> float:
        """The threshold. A score above it, or a NaN score, raises an alarm."""
        return self.flat.item(0)

    @classmethod
    def build(cls, *, model: Path | None = None, threshold: float | None = None) -> Self:
        """Create the detector from a model file. The arguments are those of `find_detector`.

        Without a model file, the detector uses the model shipped for the default stack.
        """
        path = shipped(cls.name) if model is None else model
        loaded = Model.read(path)
        detector = cls(cls._arrays(loaded, path))
        detector.stack, detector.extended = loaded.stack, loaded.extended
        if threshold is not None:
            detector.flat[0] = checked_threshold(threshold)
        return detector

    @classmethod
    def _arrays(cls, model: Model, path: Path) -> dict[str, FloatArray]:
        """Return the arrays of a model, keyed by name.

        Raises ModelError if this detector cannot use the model.
        """
        if problem := model.incompatibility(cls.name, cls.shapes):
            raise ModelError(problem, path=path)
        arrays = {}
        for name, shape in cls.shapes.items():
            try:
                array: FloatArray = np.array(model.arrays[name], np.float64)
            except (TypeError, ValueError):
                problem = f"corrupt model file: array {name!r} does not contain numbers"
                raise ModelError(problem, path=path) from None
            if array.shape != shape:
                problem = f"array {name!r} must have shape {shape}, got {array.shape}"
                raise ModelError(problem, path=path)
            _require_finite(name, array, path)
            if name in (next(iter(cls.shapes)), *cls.divisors) and not (array > 0.0).all():
                problem = f"array {name!r} must be above 0, got {array.min()}"
                raise ModelError(problem, path=path)
            arrays[name] = array
        return arrays

    def learn(self, deltas: Codes, stage: Stage) -> None:
        """Do nothing, because most models are fixed in flight. See `Detector`."""
