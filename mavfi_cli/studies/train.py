"""`mavfi train`: fly error-free missions, collect their samples in a data set, and fit detectors.

The default is the paper's training set (section VI): two obstacle densities times two obstacle
sizes, 25 flights each. Every flight has its own world seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from mavfi_cli.analysis.scores import flown_samples
from mavfi_cli.campaigns.begin import check_kinds
from mavfi_cli.campaigns.ledger import RUNS
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import ModelError
from mavfi_cli.core.types import StackMark
from mavfi_cli.detect.base import Model
from mavfi_cli.detect.fit import KINDS, check, fit
from mavfi_cli.detect.offline import Dataset
from mavfi_cli.detect.preprocess import PreprocessParams
from mavfi_cli.mission.setpoints import samples_of_tlog
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.mission import OWN_AUTOPILOT, MissionConfig
from mavfi_cli.spec.stack import load_stack

DATASET, FLIGHTS = "dataset.parquet", "flights"
TRAINING_WORLDS = ("train-0.05-3", "train-0.05-5", "train-0.2-3", "train-0.2-5")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingPlan:
    """The plan of a training: which error-free flights are used, and which detectors are fitted.

    Attributes:
        flights: number of flights per world.
        first_seed: seed of the first flight; the seeds are consecutive over all worlds.
        seed: seed of the split of the data and of the initial weights.
        n_sigma: threshold of the Gaussian model; None lets `fit` choose it.
        kinds: the detectors to fit.
        base: the other parameters of all missions.
        flown: folder with the run folders of existing flights to use; None flies the missions.
        logs: .tlog files of fault-free flights of a user's companion, to use instead.
    """

    worlds: tuple[str, ...] = TRAINING_WORLDS
    flights: int = 25
    first_seed: int = 10_000  # far from the usual seeds of flights and evaluations
    seed: int = 1
    n_sigma: float | None = None
    kinds: tuple[str, ...] = KINDS
    base: MissionConfig = field(default_factory=MissionConfig)
    flown: Path | None = None
    logs: tuple[Path, ...] = ()

    def missions(self) -> list[PlannedMission]:
        """List the missions to fly, world by world."""
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


def train(
    plan: TrainingPlan, folder: Path, options: Options, spectator: Spectator
) -> tuple[Dataset, Mapping[str, tuple[Model, Path]], int]:
    """Fly or collect flights, fit the detectors, and write the models with their provenance.

    Returns:
        The data set; the model and its file, by detector; and the number of flights that were left
        out because they were not error-free.

    Raises:
        UnknownName: a kind of detector is unknown; raised before anything is flown.
        ModelError: there are too few flights, or torch is missing; raised before anything is flown.
            Or too few of the flights are error-free, or a log contains no setpoint.
        ConfigError: n sigma is out of range, the folder has the flights of another plan, or the
            binary of a real autopilot is not named.
        MavfiError: no mission can be flown in a world.
        RecordError: a file cannot be written.
    """
    stack = _mark_of(plan)
    if plan.logs:
        flights = [samples_of_tlog(path, path.name, place) for place, path in enumerate(plan.logs)]
        if empty := [flight.world for flight in flights if not len(flight.deltas)]:
            raise ModelError(f"{empty[0]}: contains no setpoints from a companion")
        failed, autopilots = 0, {OWN_AUTOPILOT}
        check(plan.kinds, len(flights), plan.n_sigma)
    elif plan.flown is None:
        missions = plan.missions()
        check(plan.kinds, len(missions), plan.n_sigma)
        plan = replace(plan, base=plan.base.with_firmware())
        kept = replace(options, keep=Keep.ALL)
        check_kinds(plan.missions())
        run_campaign(plan.missions(), folder / FLIGHTS, kept, spectator).close()
        flights, _, autopilots = flown_samples(folder / FLIGHTS / RUNS, stack)
        failed = len(missions) - len(flights)
    else:
        flights, failed, autopilots = flown_samples(plan.flown, stack)
        check(plan.kinds, len(flights), plan.n_sigma)
    folder.mkdir(parents=True, exist_ok=True)
    dataset = Dataset(flights=tuple(flights), preprocess=PreprocessParams(), stack=stack)
    dataset.save(folder / DATASET)
    fitted = {}
    for kind in plan.kinds:
        spectator.on_note(f"fitting {kind}")
        fitted[kind] = fit(kind, dataset, seed=plan.seed, n_sigma=plan.n_sigma)
        if autopilots != {OWN_AUTOPILOT}:
            flown = {"autopilot": ", ".join(sorted(autopilots))}
            fitted[kind] = replace(fitted[kind], provenance={**fitted[kind].provenance, **flown})
    models = {kind: (model, folder / f"{kind}.json") for kind, model in fitted.items()}
    for model, path in models.values():  # all of them, or none
        model.save(path)
    return dataset, models, failed


def _mark_of(plan: TrainingPlan) -> StackMark:
    """Return the identity of the software that flew: its stack, its companion, or a mark for logs.

    The models store this identity.
    """
    if plan.base.companion is not None:
        flies = not plan.logs and plan.flown is None
        return CompanionConfig.load(plan.base.companion, starts=flies).mark
    if plan.logs:
        return StackMark.of_companion("logs", "")
    return load_stack(plan.base.stack).mark
