"""Training of detectors: the data set of error-free flights, and the models fitted to it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options
from mavfi_cli.core.errors import ModelError
from mavfi_cli.detect.base import Model
from mavfi_cli.detect.fit import check, fit
from mavfi_cli.detect.offline import Dataset
from mavfi_cli.detect.preprocess import PreprocessParams
from mavfi_cli.spec.mission import OWN_AUTOPILOT
from mavfi_cli.spec.stack import load_stack
from mavfi_cli.studies.training_flights import TrainingPlan, collect_flown, fly_training

DATASET = "dataset.parquet"


@dataclass(frozen=True, slots=True, kw_only=True)
class _TrainedDetectors:
    """The result of a training.

    Attributes:
        models: model and file of each detector.
        failed: number of flights outside the data set, because they did not reach the goal.
    """

    dataset: Dataset
    models: Mapping[str, tuple[Model, Path]]
    failed: int


def train(
    plan: TrainingPlan, folder: Path, options: Options, spectator: Spectator
) -> _TrainedDetectors:
    """Fly or collect flights, fit the detectors, and write the models with their provenance.

    Raises:
        ModelError: too few flights, an unknown kind, or torch is missing; before anything is
            flown, unless too many flights fail.
        ConfigError: n sigma is out of range, the folder has the flights of another plan, or nothing
            names the binary of a real autopilot.
        RecordError: a file cannot be written.
    """
    stack = load_stack(plan.base.stack).mark
    if plan.flown is None:
        check(plan.kinds, len(plan.missions()), plan.n_sigma)
        plan = replace(plan, base=plan.base.with_firmware())
        flights, failed = fly_training(plan, folder, options, spectator)
        autopilots = {plan.base.autopilot}
    else:
        flights, failed, autopilots = collect_flown(plan.flown, stack)
        check(plan.kinds, len(flights), plan.n_sigma)
    if not flights:
        raise ModelError("no flight reached the goal: there is nothing to fit to", path=folder)
    folder.mkdir(parents=True, exist_ok=True)
    dataset = Dataset(flights=tuple(flights), preprocess=PreprocessParams(), stack=stack)
    dataset.save(folder / DATASET)
    fitted = {}
    for kind in plan.kinds:
        spectator.on_note(f"fitting {kind}")
        model = fit(kind, dataset, seed=plan.seed, n_sigma=plan.n_sigma)
        fitted[kind] = _flown_by(autopilots, model)
    models = {}
    for kind, model in fitted.items():  # all of them, or none
        path = folder / f"{kind}.json"
        model.save(path)
        models[kind] = (model, path)
    return _TrainedDetectors(dataset=dataset, models=models, failed=failed)


def _flown_by(autopilots: Collection[str], model: Model) -> Model:
    """Return the model with the autopilots in its provenance, unless only ours has flown."""
    if {*autopilots} == {OWN_AUTOPILOT}:
        return model
    told = ", ".join(sorted(autopilots))
    return replace(model, provenance={**model.provenance, "autopilot": told})
