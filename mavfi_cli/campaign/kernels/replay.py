"""Repeat recorded runs to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.kernels import catalogue
from mavfi_cli.campaign.kernels.attack import KernelVerdict, attacker_of, golden_run
from mavfi_cli.campaign.kernels.inputs import INPUTS
from mavfi_cli.campaign.kernels.place import Place, load, template_of
from mavfi_cli.core.errors import BuildMismatch, RecordError
from mavfi_cli.core.sources import own_digest
from mavfi_cli.fi import record
from mavfi_cli.fi.isolated.attack import Attacker
from mavfi_cli.fi.isolated.journal import read_plan, read_runs
from mavfi_cli.fi.isolated.runs import completed, one_processor

# What a replay must repeat; how long things took is not part of it.
_COMPARED = (
    "outcome", "signal", "error", "magnitude", "within_tolerance", "output_sha256",
    "not_injected_reason", "activation",
)  # fmt: skip
_INJECTION = ("applied", "reason", "address", "before", "after")


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """One repeated run."""

    kernel: str
    run: int
    differs: tuple[str, ...]  # keys of the record; empty: identical
    record: dict[str, Any]


def replay_runs(folder: Path, kernels: tuple[str, ...] = (), runs: int = 0) -> Iterator[Replay]:
    """Repeat the runs of a campaign's folder.

    Args:
        folder: of the campaign.
        kernels: only these; all where none is named.
        runs: only as many of each kernel, the first; 0 for all.

    Raises:
        RecordError: the folder holds no runs of kernels that can be repeated.
        BuildMismatch: a record is of another build; says what differs.
    """
    plan = read_plan(folder)
    if "tolerance" not in plan:
        raise RecordError(f"{folder}: holds runs of a program; only our kernels' can be repeated")
    if plan.get("sources") != own_digest():  # other code lays out the memory otherwise
        raise BuildMismatch(["our own code"])
    tolerance = float(plan["tolerance"])
    found = False
    for kernel in catalogue.select(kernels):
        records = [
            entry
            for entry in read_runs(folder)
            if entry.get("kernel") == kernel.name and entry["trigger"]
        ]
        if not records:
            continue
        found = True
        template = template_of(kernel.name, folder / INPUTS)
        with one_processor():
            load(kernel.name, template)
            with closing(Place(kernel.name, template)) as place:
                attacker = attacker_of(kernel, place, golden_run(place), tolerance=tolerance)
                for entry in records[: runs or None]:
                    record.require_same_build(entry, place.layout.image)
                    yield _replay(attacker, entry)
    if not found:
        raise RecordError(f"{folder}: no runs that can be repeated")


def _replay(attacker: Attacker[KernelVerdict], entry: dict[str, Any]) -> Replay:
    again = completed(entry, attacker.run(record.fault_of(entry)))
    differs = [name for name in _COMPARED if again[name] != entry[name]]
    was, now = entry["injection"], again["injection"]
    differs += [name for name in _INJECTION if now.get(name) != was.get(name)]
    return Replay(kernel=entry["kernel"], run=entry["run"], differs=tuple(differs), record=again)
