"""The folder of a campaign: its plan, the faults as drawn, and every run as soon as it is over.

`plan.json` says what the folder holds, `faults-KERNEL.jsonl` is on the disk before the first fault
of that kernel runs, and `runs.jsonl` grows by one line a run, so a campaign that was cut off goes
on where it stopped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.core.files import write_atomically, write_json

if TYPE_CHECKING:
    from mavfi_cli.campaign.kernels.runs import Plan

PLAN, RUNS, INPUTS = "plan.json", "runs.jsonl", "inputs.pickle"
_DRAWN = ("object", "offset", "trigger", "k", "instruction_bytes", "corruption", "build_ids")


class Journal:
    """Reads and grows the folder of one campaign."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        """Open the folder, or begin it.

        Raises:
            ConfigError: it holds another campaign.
            RecordError: it cannot be written.
        """
        self._folder = folder
        known = plan_to_json(plan)
        path = folder / PLAN
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordError(f"{folder}: {error.strerror}") from None
        if path.is_file():
            stored = read_plan(folder)
            differs = sorted(key for key in known if stored.get(key) != known[key])
            if differs:
                raise ConfigError(f"holds another campaign; it differs in {differs}", path=folder)
        write_json(path, known)

    def runs_of(
        self, kernel: str, planned: Sequence[Mapping[str, Any]]
    ) -> dict[int, dict[str, Any]]:
        """The runs of a kernel that are there, of the faults that are planned now."""
        found = {}
        for entry in read_runs(self._folder, kernel):
            index = entry["run"]
            if index < len(planned) and _same_fault(entry, planned[index]):
                found[index] = entry
        return found

    def flush_plan(self, kernel: str, planned: Iterable[Mapping[str, Any]]) -> None:
        """Have the faults on the disk before the first one runs."""
        text = "".join(json.dumps(entry) + "\n" for entry in planned).encode()
        write_atomically(self._folder / f"faults-{kernel}.jsonl", lambda file: file.write(text))

    def append(self, entry: Mapping[str, Any]) -> None:
        """Add a run that is over."""
        path = self._folder / RUNS
        line = (json.dumps(entry) + "\n").encode()
        try:
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            try:
                os.write(file, line)
            finally:
                os.close(file)
        except OSError as error:
            raise RecordError(f"{path}: {error.strerror}") from None


def plan_to_json(plan: Plan) -> dict[str, Any]:
    """What results depend on; neither how many runs nor which kernels does."""
    values = asdict(plan)
    for name in ("kernels", "runs", "inputs", "model"):
        del values[name]
    model = plan.strategy().model
    values["model"] = {
        "sites": sorted(site.value for site in model.sites),
        "roles": sorted(role.value for role in model.roles),
        "field": model.field.value,
        "bits": model.count,
    }
    return values


def read_plan(folder: Path) -> dict[str, Any]:
    """What the runs of a folder depend on.

    Raises:
        RecordError: the folder holds no campaign.
    """
    path = folder / PLAN
    try:
        plan: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordError(f"{path}: {error}") from None
    return plan


def read_runs(folder: Path, kernel: str | None = None) -> Iterator[dict[str, Any]]:
    """The completed records of a folder; a last line that was cut off is left out.

    Raises:
        RecordError: the file cannot be read.
    """
    path = folder / RUNS
    if not path.is_file():
        return
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror}") from None
    for line in lines:
        try:
            entry: dict[str, Any] = json.loads(line)
        except ValueError:
            continue
        if kernel is None or entry["kernel"] == kernel:
            yield entry


def _same_fault(entry: Mapping[str, Any], planned: Mapping[str, Any]) -> bool:
    if not planned["trigger"]:
        return not entry["trigger"]
    return all(entry.get(name) == planned[name] for name in _DRAWN)
