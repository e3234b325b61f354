"""Artefacts: what was fitted, in one JSON file, with where it came from.

A file holds the schema's and mavfi's version, digests of the states table and of the
preprocessing parameters, the detector's kind, its arrays, and the provenance: worlds, seeds,
split, versions, threshold, loss curve. It is read strictly: what does not fit is refused in one
line, and nothing is guessed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, ModelError
from mavfi_cli.core.files import write_json
from mavfi_cli.core.types import FloatArray
from mavfi_cli.detect.preprocess import PreprocessParams, states_digest

SCHEMA = 1
_KEYS = frozenset(
    {"schema", "mavfi", "states", "preprocess", "preprocess_digest", "detector", "arrays",
     "provenance"}
)  # fmt: skip
SHIPPED = Path(__file__).parent / "models"


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """A fitted detector."""

    detector: str  # kind: gad, aad, range, l2
    arrays: Mapping[str, FloatArray]
    preprocess: PreprocessParams = field(default_factory=PreprocessParams)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    mavfi: str = field(default_factory=lambda: version("mavfi"))


def shipped(detector: str) -> Path:
    """Where the default model of one of our detectors lies."""
    return SHIPPED / f"{detector}.json"


def save(path: Path, model: Model) -> None:
    """Write a model atomically.

    Raises:
        ModelError: a number that is not finite; nothing is written.
        RecordError: the file could not be written.
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
            "detector": model.detector,
            "arrays": dict(model.arrays),
            "provenance": dict(model.provenance),
        },
    )


def load(
    path: Path,
    detector: str,
    shapes: Mapping[str, tuple[int, ...]],
    positive: Collection[str] = (),
) -> Model:
    """Read a model of that kind, whose arrays have these shapes.

    Args:
        positive: arrays of which every number must be above 0.

    Raises:
        ModelError: the file cannot be read or is corrupt; it is of another schema or mavfi
            version, states table, preprocessing or kind; an array is missing, unknown, of another
            shape, not finite, or out of range.
    """
    data = _read(path)
    if set(data) != _KEYS:
        odd = sorted(set(data) ^ _KEYS)
        raise ModelError(f"corrupt model file: keys {', '.join(odd)}", path=path)
    _refuse_other(path, "model schema", data["schema"], SCHEMA)
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
        preprocess=preprocess,
        provenance=data["provenance"],
        mavfi=data["mavfi"],
    )


def preprocessing(path: Path) -> PreprocessParams:
    """The preprocessing parameters of a model file, for the gate that its detector serves."""
    return _preprocess(path, _read(path))


def provenance(path: Path) -> dict[str, Any]:
    """Where a model file came from, whatever its kind; its header as well.

    Raises:
        ModelError: the file cannot be read or says nothing about it.
    """
    data = _read(path)
    told = data.get("provenance")
    if not isinstance(told, dict):
        raise ModelError("corrupt model file: provenance is no object", path=path)
    return {"mavfi": data.get("mavfi"), "detector": data.get("detector"), **told}


def checked_threshold(value: float, key: str = "threshold") -> float:
    """A threshold that makes sense: a finite number above 0.

    Raises:
        ConfigError: any other.
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
