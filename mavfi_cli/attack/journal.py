"""The folder of a campaign: its plan, its drawn faults, and its completed runs.

`plan.json` describes the campaign. `faults.jsonl` (one `faults-KERNEL.jsonl` per kernel) is written
before the first fault runs. `runs.jsonl` gains one line per run, so an interrupted campaign can
continue where it stopped.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import Json, open_own, read_json, write_atomically, write_json, writing
from mavfi_cli.fi.tracer.record_fields import FaultRecord

PLAN, RUNS = "plan.json", "runs.jsonl"
_LARGEST_PLAN = 1 << 24  # bytes
_DRAWN = ("object", "offset", "trigger", "k", "instruction_bytes", "corruption", "build_ids")


class Journal:
    """Reads and extends the folder of one campaign."""

    def __init__(
        self,
        folder: Path,
        known: Mapping[str, Any],
        *,
        runs: int,
        kernels: Sequence[str] | None = None,
    ) -> None:
        """Open the folder, or create it.

        Args:
            known: everything that determines the campaign's results, as plain values.
            runs: number of runs of each kernel when the campaign is complete.
            kernels: names of the campaign's kernels; None for a program.

        Raises:
            ConfigError: the folder holds another campaign, more runs than `runs`, or runs of
                kernels other than `kernels`.
            RecordError: the folder cannot be written.
        """
        self._folder = folder
        path = folder / PLAN
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            stored = read_plan(folder)
            differs = sorted(key for key in {*known, *stored} if stored.get(key) != known.get(key))
            if differs:
                raise ConfigError(f"holds another campaign; it differs in {differs}", path=folder)
        self._require_all(runs, kernels)
        write_json(path, known)
        self._end_last_line()

    def _end_last_line(self) -> None:
        """End a line that an interruption has cut off, so that the next run starts a new one."""
        path = self._folder / RUNS
        if path.is_file() and not path.read_bytes().endswith(b"\n"):
            self._write(b"\n")

    def _require_all(self, runs: int, kernels: Sequence[str] | None) -> None:
        """Refuse to leave out existing runs, because the summary covers the whole folder."""
        counts: dict[str, int] = {}
        for entry in read_runs(self._folder):
            kernel = entry.get("kernel", "")
            counts[kernel] = max(counts.get(kernel, 0), entry["run"] + 1)
        others = sorted(counts.keys() - set(kernels)) if kernels is not None else []
        if others:
            raise ConfigError(
                f"also holds runs of {' and '.join(others)}: name all of its kernels, or "
                "choose another folder",
                path=self._folder,
            )
        most = max(counts.values(), default=0)
        if most > runs:
            raise ConfigError(
                f"already holds {most} runs, so runs must be at least {most}, got {runs}; choose "
                "more runs or another folder",
                path=self._folder,
            )

    def runs_of(self, planned: Sequence[FaultRecord]) -> dict[int, FaultRecord]:
        """Return the existing runs of the planned faults, by number."""
        runs = {}
        for entry in read_runs(self._folder):
            index = entry["run"]
            if index < len(planned) and _same_fault(entry, planned[index]):
                runs[index] = entry
        return runs

    def flush_plan(self, name: str, planned: Iterable[FaultRecord]) -> None:
        """Write the planned faults to the named file."""
        text = "".join(json.dumps(entry) + "\n" for entry in planned).encode()
        write_atomically(self._folder / name, lambda file: file.write(text))

    def append(self, entry: FaultRecord) -> None:
        """Append a completed run."""
        self._write((json.dumps(entry) + "\n").encode())

    def _write(self, data: bytes) -> None:
        path = self._folder / RUNS
        with writing(path), open(open_own(path, os.O_WRONLY | os.O_APPEND), "ab") as file:
            file.write(data)


def read_plan(folder: Path) -> Json:
    """Read the plan of a folder.

    Raises:
        RecordError: the folder holds no campaign.
    """
    return read_json(folder / PLAN, _LARGEST_PLAN)


def read_runs(folder: Path) -> list[FaultRecord]:
    """Read the completed records of a folder; incomplete lines are skipped.

    If a run was repeated after the program was rebuilt, the later record counts.

    Raises:
        RecordError: the file cannot be read.
    """
    path = folder / RUNS
    if not path.is_file():
        return []
    with writing(path):
        lines = path.read_bytes().splitlines()
    runs: dict[tuple[str | None, int], FaultRecord] = {}
    for line in lines:
        with contextlib.suppress(AttributeError, KeyError, RecursionError, TypeError, ValueError):
            entry = json.loads(line)
            runs[entry.get("kernel"), entry["run"]] = entry
    return list(runs.values())


def _same_fault(entry: FaultRecord, planned: FaultRecord) -> bool:
    if entry.get("kernel") != planned.get("kernel"):
        return False
    golden = planned.get("golden_sha256")
    if entry.get("golden_sha256", golden) != golden:  # it was compared with another golden output
        return False
    if not planned["trigger"]:
        return not entry["trigger"]
    return all(entry.get(name) == planned.get(name) for name in _DRAWN)
