"""`mavfi vpm --fly`: fly every vehicle of the model with every scheme, and compare with the model.

The simulated vehicle and platform are TOML files, which a mission refers to by path. The name of
each file contains a digest of its contents, so equal names mean equal flights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.beside_model import (
    BASE,
    FlightSetup,
    FlightsReport,
    Key,
    MeasuredOverhead,
    side_by_side,
)
from mavfi_cli.analysis.flights import chosen, flown
from mavfi_cli.analysis.overhead import TIMES, ComputeOverhead
from mavfi_cli.campaigns.begin import check_names
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options
from mavfi_cli.campaigns.specification import Keep, require_named
from mavfi_cli.campaigns.specification_file import folder_name
from mavfi_cli.companion.pipeline import BRAKE_SHARE
from mavfi_cli.core.config import toml_text
from mavfi_cli.core.errors import CannotLift, ConfigError, VehicleProcessError
from mavfi_cli.core.files import write_text, writing
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.mission import LIMITS, MissionConfig
from mavfi_cli.spec.platform import PlatformProfile, load_platform
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.studies import fly
from mavfi_cli.studies.train import TRAINING_WORLDS, TrainingPlan, train
from mavfi_cli.vpm.model import (
    DETECTORS,
    ModelInputs,
    ModelVehicle,
    Scheme,
    safe_velocity_mps,
    schemes_with,
)
from mavfi_cli.vpm.report import CHAINS, Choices, ModelReport, report

FLOWN, TRAINING, FLIGHTS = "flown", "training", "flights"  # folders
PLATFORM = "x86"  # platform whose latencies are scaled by default
WORLDS = ("sparse", "dense")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """The plan of the flights of one vehicle with one protection scheme.

    Attributes:
        mission: the mission to fly; `RedundancyPlan.missions_of` sets its world and seed.
        files: contents of the TOML files of the vehicle and the platform, by path.
        setup: parameters of the vehicle that the comparison with the model needs.
    """

    mission: MissionConfig
    files: Mapping[Path, str]
    setup: FlightSetup

    @classmethod
    def of(
        cls,
        inputs: ModelInputs,
        scheme: Scheme,
        platform: PlatformProfile,
        chain_s: float,
        folder: Path,
        models: Path | None = None,
        stack: str = DEFAULT,
    ) -> FlightPlan:
        """Plan the flights of a scheme at the safe velocity that the model predicts for it.

        Args:
            platform: platform whose latencies are scaled to the computer's response time in the
                model.
            chain_s: response time of `platform`, before it is scaled.
            folder: absolute path of the folder for the files.
            models: folder of detector models NAME.json; None means the shipped ones.

        Raises:
            CannotLift: the rotors cannot lift this many boards.
            ConfigError: the model's numbers are not valid for a mission.
            ModelError: the folder `models` lacks the detector's model.
        """
        performance, boards_w = inputs.performance(scheme), scheme.copies * inputs.board.power_w
        velocity, cut_v = _within("v_max_mps", performance.velocity_mps, "velocity", "m/s")
        accel, cut_a = _within("a_max_mps2", performance.acceleration_mps2, "acceleration", "m/s²")
        range_m, cut_r = _within("map_range_m", inputs.range_m, "sensing range", "m")
        rate_hz, cut_f = _within("camera_rate_hz", inputs.vehicle.sensor_hz, "sensor rate", "Hz")
        stem = folder_name(f"{inputs.vehicle.name}-{scheme.name}")
        vehicle = _file(folder, stem, _vehicle(inputs, scheme, accel))
        factor = inputs.compute_s * (1.0 + scheme.overhead) / chain_s
        board = _file(folder, folder_name(f"{stem}-{platform.name}"), _platform(platform, factor))
        watched = scheme.name in DETECTORS
        mission = MissionConfig(
            vehicle=str(vehicle[0]),
            platform=str(board[0]),
            stack=stack,
            v_max_mps=velocity,
            a_max_mps2=accel,
            map_range_m=range_m,
            camera_rate_hz=rate_hz,
            detector=DetectorConfig.with_model(scheme.name, models) if watched else None,
        )
        response_s = inputs.response_s(scheme.overhead)
        return cls(
            mission=mission,
            files=dict((vehicle, board)),
            setup=FlightSetup(
                v_max_mps=velocity,
                a_max_mps2=accel,
                braking_velocity_mps=safe_velocity_mps(
                    BRAKE_SHARE * accel, response_s, inputs.range_m
                ),
                rotors_w=performance.power_w - boards_w,
                boards_w=boards_w,
                cut=tuple(filter(None, (cut_v, cut_a, cut_r, cut_f))),
            ),
        )

    def write(self) -> None:
        """Write the TOML files of the vehicle and the platform.

        Raises:
            RecordError: a file cannot be written.
        """
        for path, text in self.files.items():
            with writing(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, text)


def _vehicle(inputs: ModelInputs, scheme: Scheme, acceleration_mps2: float) -> dict[str, Any]:
    """Return the vehicle file of the simulated equivalent of the model's vehicle, as a dict.

    The simulated vehicle carries the scheme's boards and heat sinks.
    """
    vehicle, board, boards = inputs.vehicle, inputs.board, scheme.copies
    return {
        "name": f"{vehicle.name}-{scheme.name}",
        "description": f"{vehicle.name} of the performance model with {boards} x {board.name}",
        "base": vehicle.stand_in,
        "mass_kg": vehicle.mass_kg,
        "extra_payload_kg": inputs.carried_kg(boards),
        "rotor_pull_n": inputs.pull_n,
        "acceleration_mps2": acceleration_mps2,
        "hover_power_w": vehicle.hover_power_w,
        "battery_wh": vehicle.battery_wh,
        "avionics_w": boards * board.power_w,
    }


def _platform(platform: PlatformProfile, factor: float) -> dict[str, Any]:
    source = f"{platform.name}{TIMES}{factor:.6g}"
    kernels = {
        name: {"latency_s": factor * kernel.latency_s, "spread": kernel.spread, "source": source}
        for name, kernel in platform.kernels.items()
    }
    return {
        "name": source, "cores": platform.cores, "carried": platform.carried, "kernels": kernels,
    }  # fmt: skip


def _within(key: str, wanted: float, what: str, unit: str) -> tuple[float, str]:
    """Clip a value to the limits of the mission parameter `key`.

    Returns:
        The clipped value, and a phrase that describes the change, which is empty if there is none.
    """
    low, high = LIMITS[key]
    taken = min(max(wanted, low), high)
    change = f"{what} {taken:g} {unit} instead of {wanted:.4g} {unit}"
    return taken, "" if taken == wanted else change


def _file(folder: Path, stem: str, values: Mapping[str, Any]) -> tuple[Path, str]:
    text = toml_text(values)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return folder / f"{stem}-{digest}.toml", text


@dataclass(frozen=True, slots=True, kw_only=True)
class RedundancyPlan:
    """The plan of the flights of all vehicles of the performance model with all schemes.

    Attributes:
        missions: number of missions per vehicle, scheme and world.
        folder: folder of flights and pictures; recorded missions are not flown again.
        models: folder of the detectors' models; None means the shipped ones.
        train: number of error-free flights per training world for fitting the detectors of each
            vehicle; with 0, no detectors are fitted.
        stack: stack of all flights.

    Raises:
        ConfigError, UnknownName: no world is named, a world is named twice, or the missions use
            seeds of the training flights, which are reserved in all worlds.
    """

    vehicles: Sequence[ModelVehicle]
    choices: Choices
    worlds: tuple[str, ...] = WORLDS
    missions: int = 10
    first_seed: int = 1
    folder: Path
    models: Path | None = None
    train: int = 0
    stack: str = DEFAULT

    def __post_init__(self) -> None:
        require_named("world", self.worlds)
        first = TrainingPlan().first_seed
        last = first + self.train * len(TRAINING_WORLDS) - 1
        if self.train and self.first_seed <= last and first < self.first_seed + self.missions:
            raise ConfigError(
                f"seeds {first} to {last} are reserved for training: choose another --first-seed",
                key="first seed",
            )

    @property
    def origin_of_models(self) -> str:
        """A phrase that says where the detectors' models come from."""
        if self.train:
            return (
                f"fitted for each vehicle to {self.train} error-free flights in each of "
                f"{', '.join(TRAINING_WORLDS)} at its safe velocity"
            )
        if self.models is not None:
            return f"of {self.models}"
        return "the shipped ones, fitted to flights of the Solo at 3 m/s"

    def missions_of(self, plans: Mapping[Key, FlightPlan]) -> list[PlannedMission]:
        """List the missions that fly `plans`, ordered by seed.

        In this order, an interrupted campaign has complete pairs.

        Args:
            plans: flight plans by vehicle and scheme.
        """
        seeds = range(self.first_seed, self.first_seed + self.missions)
        return [
            PlannedMission(
                config=replace(plan.mission, world=world, seed=seed),
                labels={"group": vehicle, "arm": scheme, "world": world},
                pair=f"{world}/{seed}",
            )
            for seed in seeds
            for world in self.worlds
            for (vehicle, scheme), plan in plans.items()
        ]


def _plans_of(
    plan: RedundancyPlan,
    vehicle: ModelVehicle,
    schemes: Iterable[Scheme],
    options: Options,
    spectator: Spectator,
) -> Iterator[tuple[Key, FlightPlan | str]]:
    """Yield the flight plan of each scheme of a vehicle, or the reason why it cannot be flown.

    Files of vehicles and platforms are written, and detectors are fitted if the plan requires it.

    Args:
        schemes: BASE must be the first one.
    """
    platform = plan.choices.platform or load_platform(PLATFORM)
    chain_s = CHAINS[plan.choices.chain][0]([k.latency_s for k in platform.kernels.values()])
    inputs, models = plan.choices.inputs(vehicle), plan.models
    folder = plan.folder.absolute() / FLOWN
    refused: dict[int, str | None] = {}  # number of boards -> reason why they cannot fly
    for scheme in schemes:
        bare, key = scheme.name == BASE, (vehicle.name, scheme.name)
        try:
            planned = FlightPlan.of(inputs, scheme, platform, chain_s, folder, models, plan.stack)
            planned.write()
            first = replace(planned.mission, world=plan.worlds[0], seed=plan.first_seed)
            check_names(first, start=scheme.copies not in refused)
            refused.setdefault(scheme.copies, None)
        except (CannotLift, VehicleProcessError) as error:
            if bare:
                raise
            refused[scheme.copies] = str(error)
        yield key, refused[scheme.copies] or planned
        if bare and plan.train:
            models = fitted(plan, vehicle.name, planned, options, spectator)


def fitted(
    plan: RedundancyPlan, vehicle: str, flown: FlightPlan, options: Options, spectator: Spectator
) -> Path:
    """Fit detectors to error-free flights of one vehicle, and return the folder of their models.

    The flights are those of the mission in `flown`. Models that already exist are reused. The
    folder's name contains a digest of the mission and of the number of flights.

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
) -> tuple[ModelReport, FlightsReport]:
    """Fly all vehicles with all schemes, and return the reports of the model and of the flights.

    For detectors without a given overhead, the flights, and the model compared with them, use the
    paper's overhead. The report of the model uses the overhead measured in the flights.

    Args:
        overheads: overhead in per cent of the compute time, and its source, by the detector's name.

    Raises:
        MavfiError: as `run_campaign`; or a world or vehicle does not exist.
    """
    for world in plan.worlds:
        check_names(MissionConfig(world=world, seed=plan.first_seed, stack=plan.stack))
    schemes = schemes_with(overheads)
    plans = {
        key: planned
        for vehicle in plan.vehicles
        for key, planned in _plans_of(plan, vehicle, schemes.values(), options, spectator)
    }
    missions = plan.missions_of({k: p for k, p in plans.items() if isinstance(p, FlightPlan)})
    table = fly(missions, plan.folder / FLIGHTS, Keep.NONE, options, spectator)
    watched = chosen(flown(table), label_arm=DETECTORS)["number"].to_pylist()
    with Ledger(plan.folder / FLIGHTS) as ledger:
        measured = ComputeOverhead.of(mission.flight for mission in ledger.results(watched))
    sources = {name: (100.0 * own.share, own.describe("--fly")) for name, own in measured.items()}
    setups = {key: p.setup if isinstance(p, FlightPlan) else p for key, p in plans.items()}
    flights = FlightsReport(
        worlds=plan.worlds,
        missions_each=plan.missions,
        first_seed=plan.first_seed,
        stack=plan.stack,
        detectors=plan.origin_of_models,
        overheads=tuple(map(MeasuredOverhead.of, measured.values())),
        vehicles=side_by_side(report(plan.vehicles, plan.choices, schemes), setups, table),
    )
    model = report(plan.vehicles, plan.choices, schemes_with({**sources, **overheads}))
    return model, flights
