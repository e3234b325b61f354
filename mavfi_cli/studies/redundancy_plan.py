"""The missions of `mavfi vpm --fly`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mavfi_cli.analysis.beside_model import Key
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.studies.flight_plan import FlightPlan
from mavfi_cli.studies.flying import require_named
from mavfi_cli.studies.training_flights import WORLDS as TRAINING_WORLDS
from mavfi_cli.studies.training_flights import TrainingPlan
from mavfi_cli.vpm.report import Choices
from mavfi_cli.vpm.vehicle import ModelVehicle

WORLDS = ("sparse", "dense")


@dataclass(frozen=True, slots=True, kw_only=True)
class RedundancyPlan:
    """Plan of the flights of all vehicles and schemes.

    Attributes:
        missions: number per scheme and world.
        folder: folder of flights and pictures; recorded missions are not flown again.
        models: folder of the detectors' models; None takes the shipped ones.
        train: flights of each training world to which detectors are fitted for each vehicle; 0
            fits none.
        stack: stack of all flights.

    Raises:
        ConfigError, UnknownName: a world is missing or named twice, or the missions have seeds of
            training flights, which no flight may share in any world.
    """

    vehicles: Sequence[ModelVehicle]
    choices: Choices
    worlds: tuple[str, ...] = WORLDS
    missions: int
    first_seed: int
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
                f"seeds {first} to {last} are for training: choose another --first-seed",
                key="first seed",
            )

    @property
    def models_told(self) -> str:
        """Origin of the detectors' models."""
        if self.train:
            return (
                f"fitted for each vehicle to {self.train} error-free flights in each of "
                f"{', '.join(TRAINING_WORLDS)} at its safe velocity"
            )
        if self.models is not None:
            return f"of {self.models}"
        return "the shipped ones, fitted to flights of the Solo at 3 m/s"

    def list_of(self, flown: Mapping[Key, FlightPlan]) -> list[PlannedMission]:
        """The list mission by mission, so that pairs are complete if it is cut off."""
        seeds = range(self.first_seed, self.first_seed + self.missions)
        return [
            PlannedMission(
                config=replace(plan.mission, world=world, seed=seed),
                labels={"group": vehicle, "arm": scheme, "world": world},
                pair=f"{world}/{seed}",
            )
            for seed in seeds
            for world in self.worlds
            for (vehicle, scheme), plan in flown.items()
        ]
