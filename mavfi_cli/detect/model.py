"""Model files: a fitted detector with its provenance in one JSON file. Reading is strict."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, MavfiError, ModelError
from mavfi_cli.core.files import write_json
from mavfi_cli.core.types import FloatArray, StackMark
from mavfi_cli.detect.base import detector_names, find_detector
from mavfi_cli.detect.preprocess import LIMIT, PreprocessParams, states_digest
from mavfi_cli.detect.watch import EXTENDED, Ranges

SCHEMA = 2
SHIPPED = Path(__file__).parent / "models"  # one folder per stack
DEFAULT_STACK = "mavbench"  # stack of the default models


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """A fitted detector, with the keys of its file."""

    schema: int = SCHEMA
    mavfi: str = field(default_factory=lambda: version("mavfi"))
    detector: str  # kind: gad, aad, range or l2
    arrays: dict[str, Any]  # arrays of float64, which a file holds as lists
    stack: StackMark  # stack of the flights it was fitted to
    extended: Ranges  # ranges of the extended states in these flights
    states: str = field(default_factory=states_digest)
    preprocess: PreprocessParams = field(default_factory=PreprocessParams)
    preprocess_digest: str = ""  # empty: that of `preprocess`
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.preprocess_digest:
            object.__setattr__(self, "preprocess_digest", self.preprocess.digest())

    def save(self, path: Path) -> None:
        """Write the model atomically.

        Raises:
            ModelError: A number is not finite. Nothing is written.
            RecordError: The file could not be written.
        """
        for name, array in self.arrays.items():
            _require_finite(path, name, array)
        write_json(path, asdict(self))

    @classmethod
    def read(cls, path: Path) -> Model:
        """Read a model file of any kind, made by any version with this schema.

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
            raise ModelError("corrupt model file: no JSON object", path=path)
        _refuse_other(path, "model schema", data.get("schema", SCHEMA), SCHEMA)
        if set(data) != _KEYS:
            odd = sorted(set(data) ^ _KEYS)
            raise ModelError(f"corrupt model file: keys {', '.join(odd)}", path=path)
        try:
            model = structure(data, cls)
        except ConfigError as error:
            raise ModelError(f"corrupt model file: {error}", path=path) from None
        if asdict(model.preprocess) != data["preprocess"]:
            raise ModelError("corrupt model file: preprocess: parameters are missing", path=path)
        return model

    @classmethod
    def load(
        cls,
        path: Path,
        detector: str,
        shapes: Mapping[str, tuple[int, ...]],
        positive: Collection[str] = (),
    ) -> Model:
        """Read a model of a kind with arrays of the given shapes, for any stack.

        Args:
            positive: Names of arrays whose numbers must all be above 0.

        Raises:
            ModelError: As `read`; or the file has another mavfi version, state table,
                preprocessing or kind; an array is missing, unknown, of another shape, not finite,
                or out of range.
        """
        model = cls.read(path)
        _refuse_other(path, "mavfi", model.mavfi, version("mavfi"))
        _refuse_other(path, "detector", model.detector, detector)
        if model.states != states_digest():
            raise ModelError("made for another table of states; train it anew", path=path)
        if model.preprocess_digest != model.preprocess.digest():
            raise ModelError("made with another preprocessing; train it anew", path=path)
        names = [state.name for state in EXTENDED]
        if set(model.extended) != set(names):
            raise ModelError(f"corrupt model file: extended must be {', '.join(names)}", path=path)
        for name, (low, high) in model.extended.items():
            if not -LIMIT <= low <= 0 <= high <= LIMIT:
                raise ModelError(f"corrupt model file: extended: {name} is not a range", path=path)
        if set(model.arrays) != set(shapes):
            raise ModelError(f"corrupt model file: arrays must be {', '.join(shapes)}", path=path)
        arrays = {name: _array(path, name, model.arrays[name], shapes[name]) for name in shapes}
        for name in positive:
            if not (arrays[name] > 0.0).all():
                raise ModelError(f"array {name!r} holds a number that is not above 0", path=path)
        return replace(model, arrays=arrays)


_KEYS = frozenset(each.name for each in fields(Model))


def shipped(detector: str, stack: str = DEFAULT_STACK) -> Path:
    """Return the path of the shipped model of our detector for one of `shipped_stacks`."""
    return SHIPPED / stack / f"{detector}.json"


def shipped_stacks() -> list[str]:
    """Return the stacks with shipped models, in alphabetical order."""
    return sorted(folder.name for folder in SHIPPED.iterdir() if folder.is_dir())


def checked_threshold(value: float, key: str = "threshold") -> float:
    """Return a threshold that is a finite number above 0.

    Raises:
        ConfigError: The threshold is not finite or not above 0.
    """
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"must be a finite number above 0, got {value!r}", key=key)
    return float(value)


def _refuse_other(path: Path, what: str, found: object, wanted: object) -> None:
    if found != wanted:
        raise ModelError(f"made for {what} {found!r}, this is {wanted!r}", path=path)


def _require_finite(path: Path, name: str, array: FloatArray) -> None:
    if not np.isfinite(array).all():
        raise ModelError(f"array {name!r} holds a number that is not finite", path=path)


def _array(path: Path, name: str, data: object, shape: tuple[int, ...]) -> FloatArray:
    try:
        array: NDArray[np.float64] = np.array(data, np.float64)
    except (TypeError, ValueError):
        raise ModelError(
            f"corrupt model file: array {name!r} does not contain numbers", path=path
        ) from None
    if array.shape != shape:
        raise ModelError(
            f"array {name!r} has shape {array.shape}, this version needs {shape}", path=path
        )
    _require_finite(path, name, array)
    return array


def listing(models: Path | None = None) -> list[dict[str, Any]]:
    """Return one row per model: detector, file, stack, threshold, provenance, and a line about it.

    A detector without a model has one row. For a model that cannot be used, the line says why.

    Args:
        models: Folder of model files `NAME.json`; None takes those that are shipped.
    """
    return [_row(name, path) for name in detector_names() for path in _paths(name, models)]


def _paths(name: str, models: Path | None) -> list[Path | None]:
    """Return the model files of a detector; None stands for none."""
    if models is not None:
        return [models / f"{name}.json"]
    paths = [shipped(name, stack) for stack in shipped_stacks()]
    return [path for path in paths if path.is_file()] or [None]


def _row(name: str, path: Path | None) -> dict[str, Any]:
    has_model = path is not None and path.is_file()
    row: dict[str, Any] = {
        "name": name,
        "model": str(path) if has_model else None,
        "stack": None,
        "threshold": None,
        "provenance": None,
    }
    try:
        row["threshold"] = find_detector(name, model=path).threshold
        if path is None:
            return {**row, "told": "needs no training"}
        model = Model.read(path)
    except MavfiError as error:  # of the model, or of a plug-in that does not load
        return {**row, "told": f"cannot be used: {error}"}
    row["provenance"] = {"mavfi": model.mavfi, "detector": model.detector, **model.provenance}
    row["stack"] = model.stack.name
    flights = training_flights(model.provenance)
    seeds = sorted({int(end) for f in flights if (end := f.rpartition("/")[2]).isdigit()})
    span = f", seeds {seeds[0]} to {seeds[-1]}" if seeds else ""
    worlds = ", ".join(model.provenance.get("worlds", [])) or "unknown worlds"
    count = model.provenance.get("flights", len(flights))
    autopilot = model.provenance.get("autopilot")
    flown = f"{count} flights of {autopilot}" if autopilot else f"{count} flights"
    return {**row, "told": f"{flown} in {worlds}{span}; mavfi {model.mavfi}"}


def training_flights(provenance: Mapping[str, Any]) -> Sequence[str]:
    """Return the flights `world/seed` that a model has seen, of all parts of its split."""
    parts = provenance.get("split", {})
    if not isinstance(parts, Mapping):
        return []
    return [str(flight) for part in parts.values() for flight in part]
