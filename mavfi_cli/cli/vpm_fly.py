"""The flights of `mavfi vpm --fly`: plan them, fly them, and put them beside the model."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.arms import Arm, Flown, arm_missions, fly_arms, paired_ratio
from mavfi_cli.campaign.missions import canonical, changes_of
from mavfi_cli.campaign.preflight import ask_vehicle
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options
from mavfi_cli.campaign.specification.factors import check_names
from mavfi_cli.campaign.training import WORLDS as TRAINING_WORLDS
from mavfi_cli.campaign.training import TrainingPlan, train
from mavfi_cli.core.config import require_distinct
from mavfi_cli.core.errors import CannotLift, ConfigError, VehicleProcessError
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.detector_config import detector_of
from mavfi_cli.mission.platform import load_platform
from mavfi_cli.mission.stack import DEFAULT
from mavfi_cli.vpm.flight_plan import FlightPlan, flight_plan, of_world, write_files
from mavfi_cli.vpm.overhead import Overhead, overheads_of
from mavfi_cli.vpm.report import CHAINS, Choices, report, setting_of
from mavfi_cli.vpm.schemes import DETECTORS, Scheme, schemes_with
from mavfi_cli.vpm.side_by_side import side_by_side
from mavfi_cli.vpm.vehicle import Vehicle

WORLDS = ("sparse", "dense")
FLIGHTS, FLOWN, TRAINING = "flights", "flown", "training"
PLATFORM = "x86"  # whose latencies are scaled where no platform is named
BARE = "none"
Plans = dict[tuple[str, str], FlightPlan | str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ask:
    """What is to be flown.

    Attributes:
        missions: of each scheme in each world.
        folder: of flights and pictures; what it has is not flown again.
        models: of the detectors; None takes those that come with them.
        train: flights of each training world to which detectors are fitted for each vehicle; 0
            fits none.
        stack: of all flights.
    """

    vehicles: Sequence[Vehicle]
    choices: Choices
    worlds: tuple[str, ...]
    missions: int
    first_seed: int
    folder: Path
    models: Path | None = None
    train: int = 0
    stack: str = DEFAULT


def fly_and_report(
    ask: Ask,
    overheads: Mapping[str, tuple[float, str]],
    options: Options,
    spectator: Spectator,
) -> dict[str, Any]:
    """The model's report with the flights of all its rows in `flights`.

    The flights, and the model beside them, have the overheads that are given, or else the paper's;
    the model's own rows have those that were measured in the flights, where none is given.

    Args:
        overheads: of a detector's name to per cent and source.

    Raises:
        MavfiError: as `run_campaign`; a world or vehicle that does not exist.
    """
    percents = {name: percent for name, (percent, _) in overheads.items()}
    sources = {name: source for name, (_, source) in overheads.items()}
    schemes = schemes_with(percents, sources)
    plans = make_plans(ask, schemes, options, spectator)
    arms = [
        Arm(group=vehicle, name=scheme, mission=plan.mission)
        for (vehicle, scheme), plan in plans.items()
        if isinstance(plan, FlightPlan)
    ]
    missions = arm_missions(arms, ask.worlds, ask.first_seed, ask.missions)
    flown = fly_arms(missions, ask.folder / FLIGHTS, options, spectator)
    measured = measured_in(flown)
    for name, found in measured.items():
        if name not in percents:
            percents[name], sources[name] = 100.0 * found.share, found.told("--fly")
    as_flown = report(ask.vehicles, ask.choices, schemes)
    told = report(ask.vehicles, ask.choices, schemes_with(percents, sources))
    told["flights"] = {
        "worlds": list(ask.worlds),
        "missions_each": ask.missions,
        "first_seed": ask.first_seed,
        "stack": ask.stack,
        "detectors": _models_told(ask),
        **side_by_side(as_flown, plans, flown, paired_ratio, measured),
    }
    return told


def measured_in(flown: Mapping[tuple[str, str], Flown]) -> dict[str, Overhead]:
    """The overheads of the detectors in these flights, over all vehicles together."""
    return overheads_of(
        result
        for (_, scheme), arm in flown.items()
        if scheme in DETECTORS
        for result in arm.results.values()
    )


def make_plans(
    ask: Ask, schemes: Sequence[Scheme], options: Options, spectator: Spectator
) -> Plans:
    """A plan, or why there is none, for each vehicle and scheme; their files are written.

    Args:
        options, spectator: of the flights to which detectors are fitted, where that is asked for.

    Raises:
        UnknownName, VehicleProcessError: a world, a stack or a simulated vehicle that does not
            exist.
        CannotLift: a vehicle that does not lift one board.
        ModelError: a detector's model that cannot be used.
    """
    require_distinct(ask.worlds, "world")
    if ask.train:
        _require_held_out(ask)
    for world in ask.worlds:
        named = MissionConfig(world=world, seed=ask.first_seed, stack=ask.stack)
        check_names(named, ask_vehicle)
    platform = ask.choices.platform or load_platform(PLATFORM)
    chain = CHAINS[ask.choices.chain][0]
    chain_s = chain([kernel.latency_s for kernel in platform.kernels.values()])
    plans: Plans = {}
    for vehicle in ask.vehicles:
        setting = setting_of(vehicle, ask.choices)
        folder = ask.folder.absolute() / FLOWN
        refused: dict[int, str | None] = {}  # by number of boards: what the simulator says
        models = ask.models
        for scheme in schemes:  # one board without protection comes first
            key = (vehicle.name, scheme.name)
            try:
                plan = flight_plan(setting, scheme, platform, chain_s, folder, models, ask.stack)
            except CannotLift as error:
                if scheme.name == BARE:
                    raise
                plans[key] = str(error)
                continue
            if plan.mission.detector is not None:
                detector_of(plan.mission.detector, plan.mission.stack)
            write_files(plan)
            if scheme.copies not in refused:
                refused[scheme.copies] = _refusal(plan, ask, bare=scheme.name == BARE)
            plans[key] = refused[scheme.copies] or plan
            if scheme.name == BARE and ask.train:
                models = fitted(ask, vehicle.name, plan, options, spectator)
    return plans


def fitted(
    ask: Ask, vehicle: str, plan: FlightPlan, options: Options, spectator: Spectator
) -> Path:
    """The folder of detectors that are fitted to error-free flights of a plan.

    What is there is taken: the folder's name holds a digest of the mission and of the number of
    flights.

    Raises:
        ModelError: too few flights reached their goals, or torch is missing.
    """
    text = canonical([changes_of(plan.mission), ask.train])
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    folder = ask.folder / TRAINING / f"{vehicle}-{digest}"
    if not all((folder / f"{name}.json").is_file() for name in DETECTORS):
        spectator.on_note(f"{vehicle}: error-free flights to which its detectors are fitted")
        training = TrainingPlan(flights=ask.train, kinds=DETECTORS, base=plan.mission)
        train(training, folder, options, spectator, spectator.on_note)
    return folder


def _models_told(ask: Ask) -> str:
    if ask.train:
        flights = f"{ask.train} error-free flights in each of {', '.join(TRAINING_WORLDS)}"
        return f"fitted for each vehicle to {flights} at its safe velocity"
    if ask.models is not None:
        return f"of {ask.models}"
    return "the shipped ones, fitted to flights of the Solo at 3 m/s"


def _require_held_out(ask: Ask) -> None:
    """Refuse missions with the seeds of training flights, whatever their worlds."""
    first = TrainingPlan().first_seed
    last = first + ask.train * len(TRAINING_WORLDS) - 1
    if ask.first_seed <= last and first <= ask.first_seed + ask.missions - 1:
        raise ConfigError(
            f"seeds {first} to {last} are for training: choose another --first-seed",
            key="first seed",
        )


def _refusal(plan: FlightPlan, ask: Ask, *, bare: bool) -> str | None:
    """Why the simulator does not fly so many boards; an error where it is one board."""
    try:
        ask_vehicle(of_world(plan, ask.worlds[0], ask.first_seed))
    except VehicleProcessError as error:
        if bare:
            raise
        return str(error)
    return None
