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
    """The folder of one campaign, which receives the planned faults and the completed runs."""

    def __init__(
        self,
        folder: Path,
        known: Mapping[str, Any],
        *,
        runs: int,
        kernels: Sequence[str] | None = None,
    ) -> None:
        """Open the folder of a campaign, or create it.

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
                raise ConfigError(f"holds a campaign with other values of {differs}", path=folder)
        self._require_all(runs, kernels)
        write_json(path, known)
        self._end_last_line()

    def _end_last_line(self) -> None:
        """End a line that an interruption has cut off, so that the next run gets its own line."""
        path = self._folder / RUNS
        if path.is_file() and not path.read_bytes().endswith(b"\n"):
            self._write(b"\n")

    def _require_all(self, runs: int, kernels: Sequence[str] | None) -> None:
        """Raise ConfigError if the folder holds runs that this campaign does not include.

        No run may be left out, because the summary covers the whole folder.
        """
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
        """Return the completed runs of the planned faults, keyed by the number of the fault."""
        runs = {}
        for entry in read_runs(self._folder):
            index = entry["run"]
            if index < len(planned) and _same_fault(entry, planned[index]):
                runs[index] = entry
        return runs

    def flush_plan(self, name: str, planned: Iterable[FaultRecord]) -> None:
        """Write the planned faults to the file `name` in the folder, one record per line."""
        text = "".join(json.dumps(entry) + "\n" for entry in planned).encode()
        write_atomically(self._folder / name, lambda file: file.write(text))

    def append(self, entry: FaultRecord) -> None:
        """Append the record of a completed run to `runs.jsonl`."""
        self._write((json.dumps(entry) + "\n").encode())

    def _write(self, data: bytes) -> None:
        path = self._folder / RUNS
        with writing(path), open(open_own(path, os.O_WRONLY | os.O_APPEND), "ab") as file:
            file.write(data)


def read_plan(folder: Path) -> Json:
    """Read a campaign's plan from its folder.

    Raises:
        RecordError: the folder holds no campaign.
    """
    return read_json(folder / PLAN, _LARGEST_PLAN)


def read_runs(folder: Path) -> list[FaultRecord]:
    """Read the records of the completed runs in a campaign's folder, skipping damaged lines.

    If a run was repeated after the program was rebuilt, only its later record is returned.

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
