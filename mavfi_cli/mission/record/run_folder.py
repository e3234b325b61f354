"""The folder of one run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import read_parquet, writing
from mavfi_cli.mission.record.measures import FlightRecord, record_of
from mavfi_cli.spec.stack import FIRST

if TYPE_CHECKING:
    import pyarrow as pa

RESULT, FAULT, TRACE = "result.json", "fault.json", "trace.parquet"
_NEEDED = (
    "outcome", "config", "quality_of_flight", "pilot", "events", "simulated_s", "versions", "host",
)  # fmt: skip


class RunFolder:
    """Paths in a run folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.result = path / RESULT  # outcome, quality of flight, seeds, versions, configuration
        self.trace = path / TRACE  # states at every control tick
        self.plans = path / "plans.parquet"  # every waypoint of every plan
        self.kernels = path / "kernels.parquet"  # start and end of every invocation
        self.tlog = path / "flight.tlog"  # every MAVLink frame of both directions
        self.picture = path / "flight.svg"  # the flight from above, and its height
        self.fault = path / FAULT  # fault record, on disk before the fault strikes
        self.crash = path / "crash.txt"  # tracebacks of the companion and of nodes

    @classmethod
    def new(cls, parent: Path, stem: str) -> RunFolder:
        """Create an empty folder `<stem>-<number>` below `parent`; safe for parallel missions.

        Raises:
            RecordError: The folder cannot be created.
        """
        with writing(parent):
            parent.mkdir(parents=True, exist_ok=True)
            ends = (path.name.rpartition("-")[2] for path in parent.glob(f"{stem}-[0-9]*"))
            number = max((int(end) for end in ends if end.isdigit()), default=0) + 1
            while True:
                path = parent / f"{stem}-{number:03d}"
                try:
                    path.mkdir()
                    return cls(path)
                except FileExistsError:
                    number += 1
        raise AssertionError("unreachable")


def stem_of(world: str) -> str:
    """Return the prefix of a world's run folders: its name without characters unfit for paths."""
    name = world.removesuffix(".toml").rpartition("/")[2]
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name) or "world"


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
    if missing := [key for key in _NEEDED if key not in result]:
        raise RecordError(f"{folder.result}: damaged (without {', '.join(missing)})")
    # Records from before the introduction of stacks flew the stack FIRST.
    result["config"] = {"stack": FIRST, "world_seed": None, **result["config"]}
    return Run(folder, result, trace)
