"""Inputs of the kernels, recorded at several moments of a golden run."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.autonomy.collision import CollisionInputs
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.tracking import TrackingInputs, TrackingParams, TrackingState
from mavfi_cli.core.archive import pack, unpack
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import read_bounded, write_atomically
from mavfi_cli.core.types import DepthFrame, FloatArray, PointCloud

INPUTS = "inputs.npz"  # file in a campaign's folder
_LARGEST = 1 << 30  # bytes


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
    """The input and state of each kernel, recorded at one of its invocations in a golden run."""

    flight: str  # description of the flight
    frame: DepthFrame
    mapped: tuple[PointCloud, ...]  # clouds that the map already contained
    cloud: PointCloud  # the next one
    check: CollisionInputs
    task: PlanningTask
    tracking_state: TrackingState
    tracking: TrackingInputs
    tracking_params: TrackingParams


@dataclass(frozen=True, slots=True)
class _Stored:
    inputs: tuple[KernelInputs, ...]


def save_inputs(path: Path, inputs: Sequence[KernelInputs]) -> str:
    """Write the inputs to a file, and return the file's SHA-256.

    Raises:
        RecordError: the file cannot be written.
    """
    data = pack(_Stored(tuple(inputs)))
    write_atomically(path, lambda file: file.write(data))
    return hashlib.sha256(data).hexdigest()


def load_inputs(path: Path) -> tuple[tuple[KernelInputs, ...], str]:
    """Read a file that `save_inputs` wrote, and return its inputs and its SHA-256.

    Raises:
        RecordError: the file is missing or not a file of kernel inputs.
    """
    data = read_inputs(path)
    try:
        inputs = inputs_of_bytes(data)
    except ValueError as error:
        raise RecordError(f"{path}: not a file of kernel inputs ({error})") from None
    return inputs, hashlib.sha256(data).hexdigest()


def read_inputs(path: Path) -> bytes:
    """Return the bytes of a file of kernel inputs.

    Raises:
        RecordError: the file cannot be read or is too large.
    """
    return read_bounded(path, _LARGEST)


def inputs_of_bytes(data: bytes) -> tuple[KernelInputs, ...]:
    """Unpack the inputs from the bytes of a file.

    Raises:
        ValueError: the bytes do not hold kernel inputs.
    """
    inputs = unpack(data, _Stored).inputs
    if not inputs:
        raise ValueError("it contains no inputs")
    return inputs
