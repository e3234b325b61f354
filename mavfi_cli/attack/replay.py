"""Repeats recorded runs of kernels and programs bit by bit."""

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
from mavfi_cli.attack.profile import started
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.attack.target import AttackTarget, places_of
from mavfi_cli.core.errors import BuildMismatch, RecordError
from mavfi_cli.core.files import own_digest
from mavfi_cli.fi.tracer import record

# A replay must repeat these entries; durations are not among them.
_COMPARED = (
    "outcome", "signal", "exit_code", "error", "magnitude", "within_tolerance", "output_sha256",
    "not_injected_reason", "activation",
)  # fmt: skip
_INJECTION = ("applied", "reason", "address", "before", "after")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Replay:
    target: str  # name of the kernel or program
    run: int
    differs: tuple[str, ...]  # keys of the record that differ; empty if it is identical
    record: dict[str, Any]


def replay_runs(folder: Path, kernels: tuple[str, ...] = (), runs: int = 0) -> Iterator[_Replay]:
    """Repeat the runs of a campaign's folder.

    Args:
        kernels: names of the kernels; all of ours if none is named.
        runs: number of runs of each kernel, or of the program, from the first; 0 for all.

    Raises:
        RecordError: the folder has no runs that can be repeated.
        BuildMismatch: a record is of another build; says what differs.
    """
    plan, found = read_plan(folder), False
    for target in _targets(plan, folder, kernels):
        of_it = [e for e in read_runs(folder) if (e.get("kernel"),) == (target.stream or (None,))]
        records = [entry for entry in of_it if entry["trigger"]]
        if not records:
            continue
        found = True
        with one_processor(), closing(target.open()) as place:
            places = places_of(place)
            attackers = [Attacker(place=each, golden=golden_run(each)) for each in places]
            with started(places[0]) as tracee:
                image = places[0].image(tracee)
            for entry in records[: runs or None]:
                record.require_same_build(entry, image)
                yield _replay(attackers[entry.get("input", 0)], entry)
    if not found:
        raise RecordError(f"{folder}: no runs that can be repeated")


def _targets(
    plan: dict[str, Any], folder: Path, kernels: tuple[str, ...]
) -> Iterator[AttackTarget]:
    if "program" in plan:
        if kernels:
            raise RecordError(f"{folder}: holds runs of a program, not of {' and '.join(kernels)}")
        try:
            target = ProgramTarget.of_plan(plan)
        except KeyError as missing:
            problem = f"the plan of an older version, without {missing}, cannot be repeated"
            raise RecordError(f"{folder}: {problem}") from None
        yield target
        return
    if "inputs_sha256" not in plan:
        raise RecordError(f"{folder}: holds no runs of kernels or of a program")
    if plan.get("sources") != own_digest():  # other code has another memory layout
        raise BuildMismatch(["our own code"])
    for kernel in catalogue.select(kernels):
        tolerance = float(plan["tolerance"])
        yield KernelTarget(kernel=kernel, inputs=folder / INPUTS, tolerance=tolerance)


def _replay(attacker: Attacker, entry: dict[str, Any]) -> _Replay:
    again = completed(entry, attacker.run(record.fault_of(entry)))
    differs = [name for name in _COMPARED if again.get(name) != entry.get(name)]
    was, now = entry["injection"], again["injection"]
    differs += [name for name in _INJECTION if now.get(name) != was.get(name)]
    return _Replay(
        target=attacker.place.name, run=entry["run"], differs=tuple(differs), record=again
    )
