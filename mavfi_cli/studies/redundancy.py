"""`mavfi vpm --fly`: fly every row of the model, one plan per vehicle and scheme, and compare."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.beside_model import (
    BASE,
    FlightPlan,
    Key,
    RedundancyPlan,
    side_by_side,
)
from mavfi_cli.analysis.flights import chosen, flown
from mavfi_cli.analysis.overhead import ComputeOverhead
from mavfi_cli.campaigns.begin import check_names
from mavfi_cli.campaigns.detector_plans import TrainingPlan
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import canonical, changes_of
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import CannotLift, VehicleProcessError
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.studies import fly
from mavfi_cli.studies.train import train
from mavfi_cli.vpm.model import DETECTORS, ModelVehicle, Scheme, schemes_with
from mavfi_cli.vpm.report import CHAINS, report

FLOWN, TRAINING, FLIGHTS = "flown", "training", "flights"  # folders
PLATFORM = "x86"  # platform whose latencies are scaled by default


def _plans_of(
    plan: RedundancyPlan,
    vehicle: ModelVehicle,
    schemes: Iterable[Scheme],
    options: Options,
    spectator: Spectator,
) -> Iterator[tuple[Key, FlightPlan | str]]:
    """Each scheme's plan or the reason for its absence; the first one has one bare board."""
    platform = plan.choices.platform or load_platform(PLATFORM)
    chain_s = CHAINS[plan.choices.chain][0]([k.latency_s for k in platform.kernels.values()])
    setting, models = plan.choices.inputs(vehicle), plan.models
    folder = plan.folder.absolute() / FLOWN
    refused: dict[int, str | None] = {}  # number of boards -> the simulator's answer
    for scheme in schemes:
        bare, key = scheme.name == BASE, (vehicle.name, scheme.name)
        try:
            each = FlightPlan.of(setting, scheme, platform, chain_s, folder, models, plan.stack)
            each.write()
            first = replace(each.mission, world=plan.worlds[0], seed=plan.first_seed)
            check_names(first, start=scheme.copies not in refused)
            refused.setdefault(scheme.copies, None)
        except (CannotLift, VehicleProcessError) as error:
            if bare:
                raise
            refused[scheme.copies] = str(error)
        yield key, refused[scheme.copies] or each
        if bare and plan.train:
            models = fitted(plan, vehicle.name, each, options, spectator)


def fitted(
    plan: RedundancyPlan, vehicle: str, flown: FlightPlan, options: Options, spectator: Spectator
) -> Path:
    """The folder of detectors fitted to error-free flights of a plan.

    Existing models are reused, because the folder's name contains a digest of the mission and of
    the number of flights.

    Raises:
        ModelError: too few flights reached their goals, or torch is missing.
    """
    text = canonical([changes_of(flown.mission), plan.train])
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    folder = plan.folder / TRAINING / f"{vehicle}-{digest}"
    if not all((folder / f"{name}.json").is_file() for name in DETECTORS):
        spectator.on_note(f"{vehicle}: error-free flights to which its detectors are fitted")
        training = TrainingPlan(flights=plan.train, kinds=DETECTORS, base=flown.mission)
        train(training, folder, options, spectator)
    return folder


def fly_and_report(
    plan: RedundancyPlan,
    overheads: Mapping[str, tuple[float, str]],
    options: Options,
    spectator: Spectator,
) -> dict[str, Any]:
    """The model's report, with the flights of all rows in `flights`.

    The flights and the model beside them use the given overheads, or else the paper's. The model's
    own rows use the given overheads, or else those measured in the flights.

    Args:
        overheads: per cent and source, by the detector's name.

    Raises:
        MavfiError: as `run_campaign`; a world or vehicle that does not exist.
    """
    for world in plan.worlds:
        check_names(MissionConfig(world=world, seed=plan.first_seed, stack=plan.stack))
    schemes = schemes_with(overheads)
    plans = {
        key: each
        for vehicle in plan.vehicles
        for key, each in _plans_of(plan, vehicle, schemes.values(), options, spectator)
    }
    missions = plan.list_of({k: each for k, each in plans.items() if isinstance(each, FlightPlan)})
    table = fly(missions, plan.folder / FLIGHTS, Keep.NONE, options, spectator)
    over = flown(table)
    watched = [
        chosen(over, label_group=group, label_arm=name)["number"].to_pylist()
        for group, name in plans
        if name in DETECTORS
    ]
    with Ledger(plan.folder / FLIGHTS) as ledger:
        measured = ComputeOverhead.of(
            each.result for numbers in watched for each in ledger.results(numbers)
        )
    found = {name: (100.0 * each.share, each.told("--fly")) for name, each in measured.items()}
    told = report(plan.vehicles, plan.choices, schemes_with({**found, **overheads}))
    told["flights"] = {
        "worlds": list(plan.worlds),
        "missions_each": plan.missions,
        "first_seed": plan.first_seed,
        "stack": plan.stack,
        "detectors": plan.models_told,
        **side_by_side(report(plan.vehicles, plan.choices, schemes), plans, table, measured),
    }
    return told
