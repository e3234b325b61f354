"""The folder of one run: result.json, flight.svg, flight.tlog and tables.

The tables are trace.parquet, plans.parquet and kernels.parquet.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import read_parquet, write_json
from mavfi_cli.mission.record.measures import FlightRecord, record_of
from mavfi_cli.spec.stack import FIRST

if TYPE_CHECKING:
    import pyarrow as pa

RESULT = "result.json"
TRACE = "trace.parquet"
PLANS = "plans.parquet"
KERNELS = "kernels.parquet"
TLOG = "flight.tlog"
PICTURE = "flight.svg"
FAULT = "fault.json"
CRASH = "crash.txt"
_SECTIONS = ("outcome", "config", "quality_of_flight", "pilot", "events", "versions", "host")
_NEEDED = ("outcome", "config", "quality_of_flight", "pilot", "events", "simulated_s", "host")


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths in a run folder."""

    path: Path

    @property
    def result(self) -> Path:
        """Path of result.json: outcome, quality of flight, seeds, versions, configuration."""
        return self.path / RESULT

    @property
    def trace(self) -> Path:
        """Path of trace.parquet: states at every control tick."""
        return self.path / TRACE

    @property
    def plans(self) -> Path:
        """Path of plans.parquet: every waypoint of every plan."""
        return self.path / PLANS

    @property
    def kernels(self) -> Path:
        """Path of kernels.parquet: start and end of every invocation."""
        return self.path / KERNELS

    @property
    def tlog(self) -> Path:
        """Path of flight.tlog: every MAVLink frame of both directions."""
        return self.path / TLOG

    @property
    def picture(self) -> Path:
        """Path of flight.svg: top view of the flight."""
        return self.path / PICTURE

    @property
    def fault(self) -> Path:
        """Path of the fault record, which is on disk before the fault strikes."""
        return self.path / FAULT

    def write_result(self, result: dict[str, Any]) -> None:
        """Write result.json atomically."""
        write_json(self.result, result)


def stem_of(world: str) -> str:
    """Return the prefix of a world's run folders: its name without characters unfit for paths."""
    name = world.removesuffix(".toml").rpartition("/")[2]
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name) or "world"


def new_run_folder(parent: Path, stem: str) -> RunFolder:
    """Create an empty folder `<stem>-<number>` below `parent`; safe for parallel missions.

    Raises:
        RecordError: The folder cannot be created.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        taken = [int(p.name.rpartition("-")[2]) for p in parent.glob(f"{stem}-[0-9]*")
                 if p.name.rpartition("-")[2].isdigit()]  # fmt: skip
        number = max(taken, default=0) + 1
        while True:
            path = parent / f"{stem}-{number:03d}"
            try:
                path.mkdir()
                return RunFolder(path)
            except FileExistsError:
                number += 1
    except OSError as error:
        raise RecordError(f"{parent}: {error.strerror or error}") from None


@dataclass(frozen=True, slots=True)
class Run:
    """A run read from its folder."""

    folder: RunFolder
    result: dict[str, Any]
    trace: pa.Table | None

    @property
    def record(self) -> FlightRecord:
        """The sections of the result."""
        return record_of(self.result)


def load_run(path: str | Path) -> Run:
    """Read a run from its folder or from the path of its result.json.

    Raises:
        RecordError: There is no run, or it was cut off before its end or is damaged.
    """
    path = Path(path)
    folder = RunFolder(path.parent if path.name == RESULT else path)
    if not folder.path.is_dir():
        raise RecordError(f"{path}: no such run folder")
    if not folder.result.is_file():
        hint = "cut off before its end" if folder.tlog.exists() else "not a run folder"
        raise RecordError(f"{folder.path}: no {RESULT} ({hint})")
    try:
        result = json.loads(folder.result.read_text())
        trace = read_parquet(folder.trace, "trace") if folder.trace.is_file() else None
    except (OSError, ValueError) as error:
        raise RecordError(f"{folder.path}: damaged ({error})") from None
    if not isinstance(result, dict) or result.get("schema") != 1:
        raise RecordError(f"{folder.result}: written by another version of mavfi")
    lacking = [name for name in _SECTIONS if name not in result]
    if lacking:
        raise RecordError(f"{folder.result}: damaged (without {', '.join(lacking)})")
    missing = [key for key in _NEEDED if key not in result]
    if missing:
        raise RecordError(f"{folder.result}: damaged (without {', '.join(missing)})")
    # Records from before the introduction of stacks flew the stack FIRST.
    result["config"] = {"stack": FIRST, "world_seed": None, **result["config"]}
    return Run(folder, result, trace)
