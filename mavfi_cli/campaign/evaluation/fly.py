"""Fly what an evaluation needs, and read what came of it.

Two campaigns lie in the folder: `bare` without detectors, whose traces are kept because detectors
are replayed on them, and `protected`, of which only the records are kept. What is flown with
detectors depends on which faults turned out to do harm without.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from mavfi_cli.campaign.evaluation.pairs import Flights, Harm, flown_of
from mavfi_cli.campaign.evaluation.plan import NONE, EvaluationPlan, Fault, require_held_out
from mavfi_cli.campaign.factors import check_names
from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaign.outcome import MissionResult, State
from mavfi_cli.campaign.preflight import ask_vehicle
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import PROFILES, Options, fly_missing, store_plan
from mavfi_cli.core.errors import ConfigError, RecordError

BARE, PROTECTED = "bare", "protected"


def fly(plan: EvaluationPlan, folder: Path, options: Options, spectator: Spectator) -> None:
    """Fly what the folder has not yet; a larger plan of the same kind goes on from a smaller one.

    Raises:
        UnknownName, VehicleProcessError: a world or platform that does not exist.
        ModelError: a model that cannot be used, or that was made with one of these seeds.
        ConfigError: the folder's flights were protected by other models.
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    require_held_out(plan)
    for world in plan.worlds:
        check_names(replace(plan.base, world=world, seed=plan.first_seed), ask_vehicle)
    spectator.on_note("flights without detectors")
    with Ledger(folder / BARE, writing=True) as ledger:
        store_plan(ledger, plan.bare(), append=True)
        fly_missing(ledger, replace(options, keep=Keep.ALL), spectator)
    if not plan.protectors:
        return
    harmful = harmful_faults(plan, read_bare(plan, folder)[0])
    spectator.on_note(f"the same with {', '.join(plan.protectors)}")
    with Ledger(folder / PROTECTED, writing=True) as ledger:
        _require_models(plan, ledger)
        store_plan(ledger, plan.protected(harmful), append=True)
        _share_profiles(folder)
        fly_missing(ledger, replace(options, keep=Keep.NONE), spectator)


def _share_profiles(folder: Path) -> None:
    """Have both campaigns draw instructions from the same profiles: those of the bare flights."""
    profiles = folder / PROTECTED / PROFILES
    if not profiles.exists():
        try:
            profiles.symlink_to(Path("..") / BARE / PROFILES)
        except OSError as error:
            raise RecordError(f"{profiles}: {error.strerror or error}") from None


def _require_models(plan: EvaluationPlan, ledger: Ledger) -> None:
    """Have all flights of a detector protected by one model."""
    for detector in plan.protectors:
        digest, stored = model_digest(plan, detector), ledger.meta(f"model:{detector}")
        if stored is None:
            ledger.set_meta({f"model:{detector}": digest})
        elif stored != digest:
            raise ConfigError(
                f"flown with another model of {detector}: take another folder", path=ledger.folder
            )


def model_digest(plan: EvaluationPlan, detector: str) -> str:
    """A name for the contents of a detector's model file; `none` without one."""
    path = plan.model_path(detector)
    return "none" if path is None else hashlib.sha256(path.read_bytes()).hexdigest()


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
    if plan.protectors:
        missions = plan.protected(harmful_faults(plan, flights))
        _read(folder / PROTECTED, missions, flights, errors)
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
