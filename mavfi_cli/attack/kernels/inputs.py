"""Inputs of the kernels, from several moments of a golden run."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.autonomy.collision import CollisionInputs
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.tracking import TrackingInputs, TrackingParams, TrackingState
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_atomically
from mavfi_cli.core.types import DepthFrame, FloatArray, PointCloud

INPUTS = "inputs.pickle"  # file in a campaign's folder
_PROTOCOL = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningTask:
    """One request to a planner during the flight."""

    snapshot: MapSnapshot
    start_enu_m: FloatArray  # (3,)
    goal_enu_m: FloatArray  # (3,)
    bounds_enu_m: FloatArray  # (6,)
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelInputs:
    """One input of each kernel with its state, each from one invocation of a golden run."""

    flight: str  # name of the flight, in words
    frame: DepthFrame
    mapped: tuple[PointCloud, ...]  # clouds that the map already contained
    cloud: PointCloud  # the next one
    check: CollisionInputs
    task: PlanningTask
    tracking_state: TrackingState
    tracking: TrackingInputs
    tracking_params: TrackingParams


def save_inputs(path: Path, inputs: Sequence[KernelInputs]) -> str:
    """Write the inputs; return the SHA-256 of the file.

    Raises:
        RecordError: the file could not be written.
    """
    data = pickle.dumps(tuple(inputs), protocol=_PROTOCOL)
    write_atomically(path, lambda file: file.write(data))
    return hashlib.sha256(data).hexdigest()


def load_inputs(path: Path) -> tuple[tuple[KernelInputs, ...], str]:
    """Read inputs that `save_inputs` wrote, and the SHA-256 of the file.

    The file is a pickle: load only what you wrote yourself.

    Raises:
        RecordError: no such file, or it holds something else.
    """
    try:
        data = path.read_bytes()
        inputs = inputs_of_bytes(data)
    except (OSError, pickle.UnpicklingError, AttributeError, EOFError, ImportError) as error:
        raise RecordError(f"{path}: not a file of kernel inputs ({error})") from None
    return inputs, hashlib.sha256(data).hexdigest()


def inputs_of_bytes(data: bytes) -> tuple[KernelInputs, ...]:
    """Read the inputs from the bytes of such a file.

    Raises:
        pickle.UnpicklingError: the bytes are something else.
    """
    inputs: Any = pickle.loads(data)
    known = isinstance(inputs, tuple) and all(isinstance(each, KernelInputs) for each in inputs)
    if not (known and inputs):
        raise pickle.UnpicklingError(f"a {type(inputs).__name__}")
    return tuple(inputs)
