"""Reads golden runs for the detector benchmarks, and finds the rows in which messages arrived."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.types import BY_NAME, Stage
from mavfi_cli.detect.offline import columns_of
from mavfi_cli.detect.preprocess import NAMES, SPANS

MATERIAL = {"m": 1.0, "m/s": 1.0, "rad": 0.5, "s": 1.0}  # change of a value that can matter


@dataclass(frozen=True, slots=True)
class Run:
    """One golden run, with the columns of its trace."""

    world: str
    seed: int
    columns: dict[str, Any]

    @property
    def training(self) -> bool:
        """True if the run's world is one for training detectors."""
        return self.world.startswith("train-")

    @property
    def duration_s(self) -> float:
        """Duration of the run in simulated seconds."""
        stamps = np.asarray(self.columns["stamp_s"], np.float64)
        return float(stamps[-1] - stamps[0])


def golden_runs(folder: Path) -> list[Run]:
    """Return the runs without a fault in a folder and its subfolders, one per world and seed."""
    import pyarrow.parquet as pq

    found: dict[tuple[str, int], Run] = {}
    for path in sorted(folder.rglob("result.json")):
        result = json.loads(path.read_text())
        trace = path.with_name("trace.parquet")
        if result["fault"] is not None or not trace.is_file():
            continue
        world, seed = result["config"]["world"], result["config"]["seed"]
        found[world, seed] = Run(world, seed, columns_of(pq.read_table(trace)))
    if not found:
        raise SystemExit(f"error: found no golden runs with a trace in {folder}")
    return [found[key] for key in sorted(found)]


def apart(runs: list[Run]) -> tuple[list[Run], list[Run]]:
    """Return the runs in training worlds, and the runs in other worlds."""
    return [run for run in runs if run.training], [run for run in runs if not run.training]


def samples_of(run: Run, name: str) -> np.ndarray:
    """Return the values of a state, one per message that carried it."""
    values = np.ma.filled(run.columns[name].astype(np.float64), np.nan)
    return np.asarray(values)[fresh_rows(run, name)]


def fresh_rows(run: Run, name: str) -> list[int]:
    """Return the trace rows in which a new message carried a state."""
    state = BY_NAME[name]
    mates = NAMES[slice(*SPANS[state.stage])]
    values = np.column_stack(
        [np.ma.filled(run.columns[mate].astype(np.float64), np.nan) for mate in mates]
    )
    present = ~np.ma.getmaskarray(run.columns[name])
    if state.stage is Stage.CONTROL:
        return np.flatnonzero(present).tolist()
    patterns = values.view(np.int64)
    new = present.copy()
    new[1:] &= (patterns[1:] != patterns[:-1]).any(axis=1) | ~present[:-1]
    return np.flatnonzero(new).tolist()
