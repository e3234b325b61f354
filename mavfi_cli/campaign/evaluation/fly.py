"""Fly what an evaluation needs, and read what came of it.

The folder holds campaigns: `bare` without detectors, whose traces are kept because detectors are
replayed on them, and in `protected` one for each model of a detector, of which only the records are
kept. What is flown with detectors depends on which faults turned out to do harm without.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from mavfi_cli.campaign.evaluation.pairs import Flights, Harm, flown_of
from mavfi_cli.campaign.evaluation.plan import NONE, EvaluationPlan, Fault, require_held_out
from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaign.outcome import MissionResult, State
from mavfi_cli.campaign.preflight import ask_vehicle
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import PROFILES, Options, fly_missing, store_plan
from mavfi_cli.campaign.specification.factors import check_names
from mavfi_cli.core.errors import RecordError

BARE, PROTECTED = "bare", "protected"


def fly(plan: EvaluationPlan, folder: Path, options: Options, spectator: Spectator) -> None:
    """Fly what the folder has not yet; a larger plan of the same kind goes on from a smaller one.

    Raises:
        UnknownName, VehicleProcessError: a world or platform that does not exist.
        ModelError: a model that cannot be used, or that was made with one of these seeds.
        ConfigError: other versions of mavfi or its libraries flew in the folder.
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    require_held_out(plan)
    for world in plan.worlds:
        check_names(replace(plan.base, world=world, seed=plan.first_seed), ask_vehicle)
    spectator.on_note("flights without detectors")
    with Ledger(folder / BARE, writing=True) as ledger:
        store_plan(ledger, plan.bare(), append=True)
        fly_missing(ledger, replace(options, keep=Keep.ALL), spectator)
    harmful = harmful_faults(plan, read_bare(plan, folder)[0]) if plan.protectors else set()
    for detector in plan.protectors:
        spectator.on_note(f"the same with {detector}")
        with Ledger(protected_folder(plan, folder, detector), writing=True) as ledger:
            store_plan(ledger, plan.protected(detector, harmful), append=True)
            _share_profiles(folder, ledger.folder)
            fly_missing(ledger, replace(options, keep=Keep.NONE), spectator)


def protected_folder(plan: EvaluationPlan, folder: Path, detector: str) -> Path:
    """Where the flights with a detector lie: a folder a model, whatever its file is called."""
    return folder / PROTECTED / f"{detector}-{model_digest(plan, detector)[:12]}"


def model_digest(plan: EvaluationPlan, detector: str) -> str:
    """A name for the contents of a detector's model file; `none` without one."""
    path = plan.model_path(detector)
    return "none" if path is None else hashlib.sha256(path.read_bytes()).hexdigest()


def _share_profiles(folder: Path, protected: Path) -> None:
    """Draw instructions from the profiles of the bare flights: the golden flight is the same."""
    try:
        if not (protected / PROFILES).exists():
            (protected / PROFILES).symlink_to(Path("..") / ".." / BARE / PROFILES)
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror or error}") from None


def harmful_faults(plan: EvaluationPlan, flights: Flights) -> set[Fault]:
    """Faults that did harm without a detector."""
    places = {(place.target, place.field): place for place in plan.places()}
    return {
        (pair.world, pair.seed, places[pair.target, pair.field])
        for pair in flights.faults([NONE], plan.complete)
        if pair.active and pair.harm is not Harm.NONE
    }


def read_bare(plan: EvaluationPlan, folder: Path) -> tuple[Flights, list[str]]:
    """The flights without detectors; see `read`."""
    flights, errors = Flights(), list[str]()
    _read(folder / BARE, plan.bare(), flights, errors)
    return flights, errors


def read(plan: EvaluationPlan, folder: Path) -> tuple[Flights, list[str]]:
    """The flights of a plan as far as they are there.

    Returns:
        The flights, and why missions could not be flown, a line each.

    Raises:
        RecordError: nothing was flown there.
    """
    flights, errors = read_bare(plan, folder)
    harmful = harmful_faults(plan, flights)
    for detector in plan.protectors:
        missions = plan.protected(detector, harmful)
        _read(protected_folder(plan, folder, detector), missions, flights, errors)
    return flights, errors


def _read(
    folder: Path, missions: Sequence[PlannedMission], flights: Flights, errors: list[str]
) -> None:
    with Ledger(folder) as ledger:
        for entry in _chosen(ledger, missions):
            if entry.state is State.ERROR:
                errors.append(f"{canonical(dict(entry.mission.labels))}: {entry.reason}")
            else:
                flights.add(entry.mission.labels, flown_of(entry))


def _chosen(ledger: Ledger, missions: Sequence[PlannedMission]) -> Iterator[MissionResult]:
    """Results of these missions; the folder may have more."""
    wanted = {_row(mission) for mission in missions}
    return (entry for entry in ledger.results() if _row(entry.mission) in wanted)


def _row(mission: PlannedMission) -> tuple[str, str]:
    return canonical(dict(mission.labels)), canonical(changes_of(mission.config))
