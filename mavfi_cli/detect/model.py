"""Model files: a fitted detector with its provenance in one JSON file.

A file holds the versions of schema and mavfi, digests of the state table and of the preprocessing
parameters, the flown stack, the detector's kind, its arrays, the ranges of the extended states, and
the provenance: worlds, seeds, split, versions, threshold, loss curve. Reading is strict: any
mismatch is an error of one line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, ModelError
from mavfi_cli.core.files import write_json
from mavfi_cli.core.types import FloatArray, StackMark
from mavfi_cli.detect import model as model_file
from mavfi_cli.detect.base import detector_names, find_detector
from mavfi_cli.detect.preprocess import LIMIT, PreprocessParams, states_digest
from mavfi_cli.detect.watch import EXTENDED, Ranges

SCHEMA = 2
_KEYS = frozenset(
    {"schema", "mavfi", "states", "preprocess", "preprocess_digest", "stack", "detector", "arrays",
     "extended", "provenance"}
)  # fmt: skip
SHIPPED = Path(__file__).parent / "models"  # one folder per stack
DEFAULT_STACK = "mavbench"  # stack of the default models


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """A fitted detector."""

    detector: str  # kind: gad, aad, range or l2
    arrays: Mapping[str, FloatArray]
    stack: StackMark  # stack of the flights it was fitted to
    extended: Ranges  # ranges of the extended states in these flights
    preprocess: PreprocessParams = field(default_factory=PreprocessParams)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    mavfi: str = field(default_factory=lambda: version("mavfi"))


def shipped(detector: str, stack: str = DEFAULT_STACK) -> Path:
    """Return the path of the shipped model of our detector for one of `shipped_stacks`."""
    return SHIPPED / stack / f"{detector}.json"


def shipped_stacks() -> list[str]:
    """Return the stacks with shipped models, in alphabetical order."""
    return sorted(folder.name for folder in SHIPPED.iterdir() if folder.is_dir())


def save(path: Path, model: Model) -> None:
    """Write a model atomically.

    Raises:
        ModelError: A number is not finite. Nothing is written.
        RecordError: The file could not be written.
    """
    for name, array in model.arrays.items():
        if not np.isfinite(array).all():
            raise ModelError(f"array {name!r} holds a number that is not finite", path=path)
    write_json(
        path,
        {
            "schema": SCHEMA,
            "mavfi": model.mavfi,
            "states": states_digest(),
            "preprocess": asdict(model.preprocess),
            "preprocess_digest": model.preprocess.digest(),
            "stack": asdict(model.stack),
            "detector": model.detector,
            "arrays": dict(model.arrays),
            "extended": {name: list(limits) for name, limits in model.extended.items()},
            "provenance": dict(model.provenance),
        },
    )


def load(
    path: Path, detector: str, shapes: Mapping[str, tuple[int, ...]], positive: Collection[str] = ()
) -> Model:
    """Read a model of a kind with arrays of the given shapes.

    Args:
        positive: Names of arrays whose numbers must all be above 0.

    Returns:
        The model of any stack. The caller compares its stack with the mission's.

    Raises:
        ModelError: The file cannot be read or is corrupt; it has another schema, mavfi version,
            state table, preprocessing or kind; an array is missing, unknown, of another shape, not
            finite, or out of range.
    """
    data = _read(path)
    _refuse_other(path, "model schema", data.get("schema", SCHEMA), SCHEMA)
    if set(data) != _KEYS:
        odd = sorted(set(data) ^ _KEYS)
        raise ModelError(f"corrupt model file: keys {', '.join(odd)}", path=path)
    _refuse_other(path, "mavfi", data["mavfi"], version("mavfi"))
    _refuse_other(path, "detector", data["detector"], detector)
    if data["states"] != states_digest():
        raise ModelError("made for another table of states; train it anew", path=path)
    preprocess = _preprocess(path, data)
    if data["preprocess_digest"] != preprocess.digest():
        raise ModelError("made with another preprocessing; train it anew", path=path)
    if not isinstance(data["provenance"], dict):
        raise ModelError("corrupt model file: provenance is no object", path=path)
    arrays = _arrays(path, data["arrays"], shapes)
    for name in positive:
        if not (arrays[name] > 0.0).all():
            raise ModelError(f"array {name!r} holds a number that is not above 0", path=path)
    return Model(
        detector=detector,
        arrays=arrays,
        stack=_stack(path, data["stack"]),
        extended=_ranges(path, data["extended"]),
        preprocess=preprocess,
        provenance=data["provenance"],
        mavfi=data["mavfi"],
    )


def preprocessing(path: Path) -> PreprocessParams:
    """Read the preprocessing parameters of a model file, for the gate of its detector."""
    return _preprocess(path, _read(path))


def provenance(path: Path) -> dict[str, Any]:
    """Read provenance and header of a model file of any kind.

    Raises:
        ModelError: The file cannot be read or has no provenance.
    """
    data = _read(path)
    recorded = data.get("provenance")
    if not isinstance(recorded, dict):
        raise ModelError("corrupt model file: provenance is no object", path=path)
    header = {key: data.get(key) for key in ("mavfi", "detector", "stack")}
    return {**header, **recorded}


def checked_threshold(value: float, key: str = "threshold") -> float:
    """Return a threshold that is a finite number above 0.

    Raises:
        ConfigError: The threshold is not finite or not above 0.
    """
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"must be a finite number above 0, got {value!r}", key=key)
    return float(value)


def _read(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelError(error.strerror or str(error), path=path) from None
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        raise ModelError("corrupt model file: not JSON", path=path) from None
    if not isinstance(data, dict):
        raise ModelError("corrupt model file: no JSON object", path=path)
    return data


def _preprocess(path: Path, data: Mapping[str, Any]) -> PreprocessParams:
    values = data.get("preprocess")
    if not isinstance(values, dict):
        raise ModelError("corrupt model file: preprocess is no object", path=path)
    try:
        params = structure(values, PreprocessParams)
    except ConfigError as error:
        raise ModelError(f"corrupt model file: preprocess: {error}", path=path) from None
    if set(values) != set(asdict(params)):
        raise ModelError("corrupt model file: preprocess: parameters are missing", path=path)
    return params


def _stack(path: Path, data: object) -> StackMark:
    if not (
        isinstance(data, dict)
        and set(data) == {"name", "digest"}
        and all(isinstance(value, str) for value in data.values())
    ):
        raise ModelError("corrupt model file: stack must be a name and a digest", path=path)
    return StackMark(**data)


def _ranges(path: Path, data: object) -> Ranges:
    names = [state.name for state in EXTENDED]
    if not isinstance(data, dict) or set(data) != set(names):
        raise ModelError(f"corrupt model file: extended must be {', '.join(names)}", path=path)
    for name, limits in data.items():
        whole = isinstance(limits, list) and [type(limit) for limit in limits] == [int, int]
        if not (whole and -LIMIT <= limits[0] <= 0 <= limits[1] <= LIMIT):
            raise ModelError(f"corrupt model file: extended: {name} is no range", path=path)
    return {name: (data[name][0], data[name][1]) for name in names}


def _refuse_other(path: Path, what: str, found: object, wanted: object) -> None:
    if found != wanted:
        raise ModelError(f"made for {what} {found!r}, this is {wanted!r}", path=path)


def _arrays(
    path: Path, data: object, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, FloatArray]:
    if not isinstance(data, dict) or set(data) != set(shapes):
        raise ModelError(f"corrupt model file: arrays must be {', '.join(shapes)}", path=path)
    arrays = {}
    for name, shape in shapes.items():
        try:
            array: NDArray[np.float64] = np.array(data[name], np.float64)
        except (TypeError, ValueError):
            raise ModelError(
                f"corrupt model file: array {name!r} is no numbers", path=path
            ) from None
        if array.shape != shape:
            raise ModelError(
                f"array {name!r} has shape {array.shape}, this version needs {shape}", path=path
            )
        if not np.isfinite(array).all():
            raise ModelError(f"array {name!r} holds a number that is not finite", path=path)
        arrays[name] = array
    return arrays


def listing(models: Path | None = None) -> list[dict[str, Any]]:
    """A row a model: detector, file, stack, threshold, provenance, and a line about it.

    A detector without a model has one row. One that cannot be used is told with the reason instead
    of its threshold.

    Args:
        models: folder of model files `NAME.json`; None takes those that are shipped.
    """
    return [_row(name, path) for name in detector_names() for path in _paths(name, models)]


def _paths(name: str, models: Path | None) -> list[Path | None]:
    """The model files of a detector; None stands for none."""
    if models is not None:
        return [models / f"{name}.json"]
    shipped = [model_file.shipped(name, stack) for stack in model_file.shipped_stacks()]
    return [path for path in shipped if path.is_file()] or [None]


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
        if path is not None:
            row["provenance"] = model_file.provenance(path)
            row["stack"] = row["provenance"].pop("stack")["name"]
    except ModelError as error:
        return {**row, "told": f"cannot be used: {error}"}
    return {**row, "told": _told(row["provenance"])}


def _told(provenance: dict[str, Any] | None) -> str:
    if provenance is None:
        return "needs no training"
    flights = training_flights(provenance)
    seeds = sorted({int(end) for f in flights if (end := f.rpartition("/")[2]).isdigit()})
    span = f", seeds {seeds[0]} to {seeds[-1]}" if seeds else ""
    return (
        f"{provenance.get('flights', len(flights))} flights in "
        f"{', '.join(provenance.get('worlds', [])) or 'unknown worlds'}{span}; "
        f"mavfi {provenance['mavfi']}"
    )


def training_flights(provenance: Mapping[str, Any]) -> Sequence[str]:
    """Flights `world/seed` that a model has seen, of all parts of its split."""
    parts = provenance.get("split", {})
    if not isinstance(parts, Mapping):
        return []
    return [str(flight) for part in parts.values() for flight in part]
