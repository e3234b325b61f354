"""Repeats recorded runs of kernels bit by bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.attack.attacker import Attacker, golden_run
from mavfi_cli.attack.campaign import completed, one_processor
from mavfi_cli.attack.journal import read_plan, read_runs
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.inputs import INPUTS
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.core.errors import BuildMismatch, RecordError
from mavfi_cli.core.files import own_digest
from mavfi_cli.fi.tracer import record

# A replay must repeat these entries; durations are not among them.
_COMPARED = (
    "outcome", "signal", "error", "magnitude", "within_tolerance", "output_sha256",
    "not_injected_reason", "activation",
)  # fmt: skip
_INJECTION = ("applied", "reason", "address", "before", "after")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Replay:
    kernel: str
    run: int
    differs: tuple[str, ...]  # keys of the record that differ; empty if it is identical
    record: dict[str, Any]


def replay_runs(folder: Path, kernels: tuple[str, ...] = (), runs: int = 0) -> Iterator[_Replay]:
    """Repeat the runs of a campaign's folder.

    Args:
        kernels: names of the kernels; all of ours if none is named.
        runs: number of runs of each kernel, from the first; 0 for all.

    Raises:
        RecordError: the folder has no kernel runs that can be repeated.
        BuildMismatch: a record is of another build; says what differs.
    """
    plan = read_plan(folder)
    if "inputs_sha256" not in plan:
        raise RecordError(f"{folder}: holds runs of a program; only our kernels' can be repeated")
    if plan.get("sources") != own_digest():  # other code has another memory layout
        raise BuildMismatch(["our own code"])
    found = False
    for kernel in catalogue.select(kernels):
        name = catalogue.find(kernel).name
        records = [e for e in read_runs(folder) if e.get("kernel") == name and e["trigger"]]
        if not records:
            continue
        found = True
        tolerance = float(plan["tolerance"])
        target = KernelTarget(kernel=kernel, inputs=folder / INPUTS, tolerance=tolerance)
        with one_processor(), closing(target.open()) as place:
            attackers = [Attacker(place=each, golden=golden_run(each)) for each in place.inputs]
            for entry in records[: runs or None]:
                record.require_same_build(entry, place.layout.image)
                yield _replay(attackers[entry.get("input", 0)], entry)
    if not found:
        raise RecordError(f"{folder}: no runs that can be repeated")


def _replay(attacker: Attacker, entry: dict[str, Any]) -> _Replay:
    again = completed(entry, attacker.run(record.fault_of(entry)))
    differs = [name for name in _COMPARED if again[name] != entry[name]]
    was, now = entry["injection"], again["injection"]
    differs += [name for name in _INJECTION if now.get(name) != was.get(name)]
    return _Replay(kernel=entry["kernel"], run=entry["run"], differs=tuple(differs), record=again)
