"""Data set to fit models to: the samples that the gate sees, grouped by flight.

One row is one judged message: a collision report, a control tick, or one step of a published plan
from waypoint to waypoint. Its deltas are the detector's input.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import ModelError
from mavfi_cli.core.files import read_parquet, write_parquet
from mavfi_cli.core.types import FloatArray, StackMark, Stage
from mavfi_cli.detect.preprocess import COUNT, NAMES, Codes, PreprocessParams, states_digest
from mavfi_cli.detect.watch import EXTENDED

SCHEMA = "2"
_CODED = (*NAMES, *(state.name for state in EXTENDED))
_FLAGS = ("reports", "plan_steps", "new_waypoint")
_META = (b"mavfi_samples", b"mavfi_states", b"mavfi_preprocess")
_STACK = (b"mavfi_stack", b"mavfi_stack_digest")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSamples:
    """Samples of one error-free flight, oldest first."""

    world: str
    seed: int
    stamps_s: FloatArray  # (n,)
    reports: NDArray[np.bool_]  # (n,) True for a collision report
    plan_steps: NDArray[np.bool_]  # (n,) True for a step of a plan; otherwise a control tick
    new_waypoint: NDArray[np.bool_]  # (n,) True for a control tick with new planning states
    deltas: Codes  # (n, COUNT)
    extended: Codes  # (n, 3) extended states; those of a plan are in the row of its first step

    def of_stage(self, stage: Stage) -> Codes:
        """Return the deltas (m, COUNT) of the samples with new states of a stage."""
        if stage is Stage.PERCEPTION:
            return self.deltas[self.reports]
        if stage is Stage.PLANNING:
            return self.deltas[self.new_waypoint | self.plan_steps]
        return self.deltas[~(self.reports | self.plan_steps)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset:
    """Flights with distinct combinations of world and seed."""

    flights: tuple[FlightSamples, ...]
    preprocess: PreprocessParams
    stack: StackMark  # stack of all flights

    def __post_init__(self) -> None:
        keys = [(flight.world, flight.seed) for flight in self.flights]
        if len(set(keys)) != len(keys):
            raise ModelError("a data set holds each flight (world and seed) once only")

    def __len__(self) -> int:
        return len(self.flights)

    def save(self, path: Path) -> None:
        """Write the data set as Parquet, atomically. Equal data sets give equal bytes."""
        import pyarrow as pa

        flights = self.flights
        lengths = [len(flight.stamps_s) for flight in flights]
        columns: dict[str, pa.Array] = {
            "world": pa.array(np.repeat([f.world for f in flights], lengths).tolist(), pa.string()),
            "seed": pa.array(np.repeat([f.seed for f in flights], lengths), pa.int64()),
            "stamp_s": pa.array(_joined([f.stamps_s for f in flights]), pa.float64()),
        }
        for flag in _FLAGS:
            columns[flag] = pa.array(_joined([getattr(f, flag) for f in flights]), pa.bool_())
        codes = [np.column_stack([f.deltas, f.extended]) for f in flights]
        coded = np.concatenate([np.zeros((0, len(_CODED)), np.int16), *codes])
        for place, name in enumerate(_CODED):
            columns[name] = pa.array(coded[:, place], pa.int16())
        stack = self.stack.name.encode(), self.stack.digest.encode()
        table = pa.table(columns).replace_schema_metadata(
            dict(zip((*_META, *_STACK), (*_signature(self.preprocess), *stack), strict=True))
        )
        write_parquet(path, table)

    @classmethod
    def load(cls, path: Path, preprocess: PreprocessParams | None = None) -> Dataset:
        """Read a data set.

        Args:
            preprocess: Parameters that the data set must have been made with.

        Raises:
            RecordError: The file is unreadable.
            ModelError: It is not a data set, or was made with another state table or other
                preprocessing.
        """
        params = preprocess or PreprocessParams()
        table = read_parquet(path, "data set")
        metadata = table.schema.metadata or {}
        found = tuple(metadata.get(key) for key in _META)
        if found[0] is None:
            raise ModelError("is not a data set of mavfi", path=path)
        if found != _signature(params) or not set(_STACK) <= set(metadata):
            raise ModelError(
                "made for another version, table of states or preprocessing; fly it anew", path=path
            )
        name, digest = (metadata[key].decode() for key in _STACK)
        stack = StackMark(name=name, digest=digest)
        return cls(flights=tuple(_flights(table)), preprocess=params, stack=stack)


def _signature(preprocess: PreprocessParams) -> tuple[bytes, ...]:
    return SCHEMA.encode(), states_digest().encode(), preprocess.digest().encode()


def _joined(arrays: list[NDArray[np.generic]]) -> NDArray[np.generic]:
    return np.concatenate(arrays) if arrays else np.zeros(0)


def _flights(table: object) -> Iterable[FlightSamples]:
    columns = {name: table[name].to_numpy() for name in table.column_names}  # type: ignore[attr-defined,index]
    worlds, seeds = columns["world"], columns["seed"]
    rows = len(worlds)
    if not rows:
        return
    changed = (worlds[1:] != worlds[:-1]) | (seeds[1:] != seeds[:-1])
    edges = [0, *(np.flatnonzero(changed) + 1).tolist(), rows]
    coded = np.column_stack([columns[name] for name in _CODED]).astype(np.int16)
    for start, end in itertools.pairwise(edges):
        yield FlightSamples(
            world=str(worlds[start]),
            seed=int(seeds[start]),
            stamps_s=columns["stamp_s"][start:end],
            **{flag: columns[flag][start:end].astype(np.bool_) for flag in _FLAGS},
            deltas=coded[start:end, :COUNT],
            extended=coded[start:end, COUNT:],
        )
