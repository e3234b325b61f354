"""The error-free flights to which detectors are fitted, and the samples of them.

The paper's training set (section VI): two obstacle densities times two obstacle sizes, 25 flights
each. Every flight has its own world seed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import ModelError
from mavfi_cli.core.types import Outcome, StackMark
from mavfi_cli.detect.fit import KINDS
from mavfi_cli.detect.offline import FlightSamples, columns_of
from mavfi_cli.detect.preprocess import PreprocessParams
from mavfi_cli.mission.run_folder import RESULT, Run, load_run
from mavfi_cli.spec.mission import OWN_AUTOPILOT, MissionConfig
from mavfi_cli.spec.stack import load_stack

WORLDS = ("train-0.05-3", "train-0.05-5", "train-0.2-3", "train-0.2-5")
FLIGHTS = 25  # flights per world
FIRST_SEED = 10_000  # far from the usual seeds of flights and evaluations
FLIGHTS_FOLDER = "flights"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingPlan:
    """Plan of the flights and of the fit.

    Attributes:
        flights: number per world.
        first_seed: seed of the first flight; each further flight of any world adds 1.
        seed: seed of the split and of the initial weights.
        n_sigma: threshold of the Gaussian model; None takes the default.
        flown: folder of run folders to fit to; None flies the missions.
    """

    worlds: tuple[str, ...] = WORLDS
    flights: int = FLIGHTS
    first_seed: int = FIRST_SEED
    seed: int = 1
    n_sigma: float | None = None
    kinds: tuple[str, ...] = KINDS
    base: MissionConfig = field(default_factory=MissionConfig)
    flown: Path | None = None

    def missions(self) -> list[PlannedMission]:
        """The flights, world by world."""
        return [
            PlannedMission(
                config=replace(
                    self.base, world=world, seed=self.first_seed + place * self.flights + number
                ),
                labels={"world": world},
            )
            for place, world in enumerate(self.worlds)
            for number in range(self.flights)
        ]


def fly_training(
    plan: TrainingPlan, folder: Path, options: Options, spectator: Spectator
) -> tuple[list[FlightSamples], int]:
    """Fly the missing flights, and collect the samples of those that reached the goal.

    Returns:
        The samples, and the number of other flights.
    """
    missions, options = plan.missions(), replace(options, keep=Keep.ALL)
    with run_campaign(missions, folder / FLIGHTS_FOLDER, options, spectator) as ledger:
        flights = [
            _samples(load_run(entry.path), entry.mission.config.world)
            for entry in ledger.results()
            if entry.outcome == Outcome.SUCCESS.value and entry.path is not None
        ]
    return flights, len(missions) - len(flights)


def _samples(run: Run, name: str) -> FlightSamples:
    assert run.trace is not None
    columns, plans = columns_of(run.trace), run.folder.read_plans()
    return FlightSamples.of_trace(
        columns, name, run.record.config["seed"], PreprocessParams(), plans
    )


def collect_flown(flown: Path, stack: StackMark) -> tuple[list[FlightSamples], int, set[str]]:
    """Collect the samples of the error-free flights among the run folders of a folder.

    Returns:
        The samples, the number of other flights, and the autopilots that flew. A flight has the
        name of its world, or that of its run folder if the world and the seed have been flown
        before.
    """
    runs = [load_run(path) for path in sorted(flown.glob(f"*/{RESULT}"))]
    usable = [run for run in runs if _is_error_free(run, stack)]
    if not usable:
        told = f"no error-free flight of the stack {stack.name!r} among {len(runs)} runs"
        raise ModelError(told, path=flown)
    flights: dict[tuple[str, int], FlightSamples] = {}
    for run in usable:
        config = run.record.config
        world = config["world"]
        name = run.folder.path.name if (world, config["seed"]) in flights else world
        flights[name, config["seed"]] = _samples(run, name)
    autopilots = {run.record.config.get("autopilot", OWN_AUTOPILOT) for run in usable}
    return list(flights.values()), len(runs) - len(usable), autopilots


def _is_error_free(run: Run, stack: StackMark) -> bool:
    """Return True for a flight of the stack that reached the goal without fault and alarm."""
    record = run.record
    asked = (record.config["fault"], record.config["instruction"])
    return (
        record.outcome == Outcome.SUCCESS.value
        and asked == (None, None)
        and not (record.detection or {}).get("alarm_count")
        and load_stack(record.config["stack"]).mark.digest == stack.digest
    )
