"""`mavfi detect evaluate`: evaluate detectors on missions outside the training data.

The folder contains the campaign `bare`, which is flown without detectors, and the subfolder
`protected` with one campaign for each detector model. `bare` keeps its traces, which are replayed
through the detectors. `protected` keeps only records. Which missions it contains depends on which
faults do harm without a detector.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from mavfi_cli.analysis.detectors import (
    ERROR_FREE,
    FAULT,
    NONE,
    EvaluatedPlan,
    Evaluation,
    Scored,
    harmful,
    pairs_of,
    results,
)
from mavfi_cli.analysis.flights import errors, flown
from mavfi_cli.analysis.scores import scored
from mavfi_cli.campaigns.begin import check_names
from mavfi_cli.campaigns.missions import Label, PlannedMission, changes_of
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import PROFILES, Options
from mavfi_cli.campaigns.specification import Keep, require_named
from mavfi_cli.core.errors import ConfigError, ModelError
from mavfi_cli.core.installed import installed_versions
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import DType, Stage
from mavfi_cli.detect.base import PLUG_INS, Model
from mavfi_cli.fi.bits import Field
from mavfi_cli.spec.detector import STAGES, DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.studies import fly

# Of evaluation.json; version 1 counted delays over 5 % as harm, even if the golden flight failed.
SCHEMA = 2
BARE, PROTECTED = "bare", "protected"
WORLDS = ("sparse", "dense", "factory", "farm")
DETECTORS = (NONE, "range", "l2", "gad", "aad")
INTEGER = "integer"  # all bits of states that have no sign, exponent or mantissa
FIELDS = (Field.SIGN.value, Field.EXPONENT.value, Field.MANTISSA.value, INTEGER)
_NODES = {
    "octomap": Stage.PERCEPTION,
    "collision_check": Stage.PERCEPTION,
    "point_cloud": Stage.PERCEPTION,
    "planner": Stage.PLANNING,
    "control": Stage.CONTROL,
}
SOURCE, INSTRUCTION = "source", "instruction"
_DRAWS = 1000  # maximum number of fault seeds tried to draw a state of the required type


# Fields of a plan that its description copies unchanged.
_DESCRIBED = ("worlds", "protect", "level", "flights", "harmless_flights", "golden_flights",
              "first_seed", "seed")  # fmt: skip


class _Site(NamedTuple):
    stage: str  # of the corrupted kernel or of its output
    target: str  # a stage, or a node
    field: str  # a bit field, `integer`, or `any`


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationPlan:
    """The plan of an evaluation of detectors: which missions are flown, with which faults.

    Attributes:
        detectors: names; `none` is always flown, even if it is not named.
        flights: number of missions per world that are flown with faults: once for each of `places`,
            with one fault.
        harmless_flights: number of these missions, starting with the first, in which all faults are
            repeated with the detectors. In the other missions, only harmful faults are repeated.
        golden_flights: number of error-free missions per world; the first `flights` of them also
            get faults.
        first_seed: first seed of the missions; training seeds start at 10 000.
        models: folder of model files `NAME.json`; None means the models shipped for the stack of
            `base`.
        level: source or instruction.
        fields: bit fields to strike at source level.
        seed: root of the faults' seeds.
        base: the other parameters of all missions.

    Raises:
        ConfigError, UnknownName: a list of names is empty, or contains a name that is unknown or
            repeated.
    """

    worlds: tuple[str, ...] = WORLDS
    detectors: tuple[str, ...] = DETECTORS
    flights: int = 25
    harmless_flights: int = 5
    golden_flights: int = 100
    first_seed: int = 500_000
    protect: tuple[str, ...] = STAGES
    models: Path | None = None
    level: str = SOURCE
    fields: tuple[str, ...] = FIELDS
    seed: int = 1
    base: MissionConfig = field(default_factory=MissionConfig)

    def __post_init__(self) -> None:
        require_named("level", (self.level,), (SOURCE, INSTRUCTION))
        require_named("world", self.worlds)
        require_named("detector", self.detectors, (NONE, *PLUG_INS.names))
        require_named("stage", self.protect, STAGES)
        require_named("field", self.fields, FIELDS)

    @property
    def protectors(self) -> tuple[str, ...]:
        """The detectors other than `none`."""
        return tuple(name for name in self.detectors if name != NONE)

    @property
    def seeds(self) -> range:
        """Seeds of the missions, the same in each world; the first `flights` of them get faults."""
        return range(self.first_seed, self.first_seed + self.golden_flights)

    def complete(self, seed: int) -> bool:
        """Return True if even the harmless faults of this seed are flown with detectors."""
        return seed in self.seeds[: self.harmless_flights]

    def detector_config(self, detector: str) -> DetectorConfig:
        """Return the configuration with which missions run a detector.

        Raises:
            ModelError: the folder `models` has no file for this detector.
        """
        return DetectorConfig.with_model(detector, self.models, self.protect)

    def require_held_out(self) -> None:
        """Check that every detector can be loaded, and was not trained on a seed of this plan.

        A seed is rejected whatever its world, because two worlds may use the same random numbers.

        Raises:
            ModelError: a model cannot be used, or was trained on one of these missions.
        """
        for detector in map(self.detector_config, self.protectors):
            detector.build(self.base.stack)
            path = detector.model_path(self.base.stack)
            for flight in () if path is None else Model.read(path).training_flights:
                seed = flight.rpartition("/")[2]
                if seed.isdigit() and int(seed) in self.seeds:
                    raise ModelError(
                        f"{detector.name} was fitted to the flight {flight}, so seeds "
                        f"{self.seeds.start} to {self.seeds.stop - 1} are not held out; choose "
                        "another --first-seed",
                        path=path,
                    )

    def described(self) -> EvaluatedPlan:
        """Return the plan for the report, with each detector's threshold and model digest."""
        stack = self.base.stack
        configs = [self.detector_config(name) for name in self.protectors]
        return EvaluatedPlan(
            detectors={
                config.name: {
                    "threshold": config.build(stack).threshold,
                    "model_sha256": config.model_digest(stack),
                }
                for config in configs
            },
            places=[place._asdict() for place in self.places()],
            mission=dict(changes_of(self.base)),
            **{name: getattr(self, name) for name in _DESCRIBED},
        )

    def places(self) -> list[_Site]:
        """List the sites at which the plan injects faults.

        At instruction level, these are nodes. At source level, each is a stage with a bit field.
        """
        if self.level == INSTRUCTION:
            return [_Site(stage.value, node, Field.ANY.value) for node, stage in _NODES.items()]
        return [
            _Site(stage.value, stage.value, name)
            for stage, name in itertools.product(Stage, self.fields)
            if stage is not Stage.CONTROL or name != INTEGER  # its states are all float64
        ]

    def missions(
        self, detector: str = NONE, harmful: Collection[tuple[Any, ...]] = ()
    ) -> list[PlannedMission]:
        """List the golden missions, then those with a fault, all with the given detector.

        Args:
            harmful: world, seed, stage, target and field of each fault that does harm without a
                detector. With a detector, only these faults are flown, and all faults of those
                missions for which `complete` returns True.
        """
        golden = itertools.product(self.worlds, self.seeds)
        faulty = itertools.product(self.worlds, self.seeds[: self.flights], self.places())
        return [self._mission(world, seed, None, detector) for world, seed in golden] + [
            self._mission(world, seed, place, detector)
            for world, seed, place in faulty
            if detector == NONE or self.complete(seed) or (world, seed, *place) in harmful
        ]

    def _mission(self, world: str, seed: int, place: _Site | None, detector: str) -> PlannedMission:
        kind = ERROR_FREE if place is None else FAULT
        labels: dict[str, Label] = {
            "kind": kind, "world": world, "seed": seed, "detector": detector
        }  # fmt: skip
        config = replace(self.base, world=world, seed=seed)
        if place is not None:
            config = replace(config, **self._fault(place, world, seed))
            labels |= {"level": self.level, **place._asdict()}
        if detector != NONE:
            config = replace(config, detector=self.detector_config(detector))
        return PlannedMission(config=config, labels=labels)

    def _fault(self, site: _Site, world: str, seed: int) -> dict[str, Any]:
        drawn = (self.seed, "evaluation", world, seed, site.target, site.field)
        if self.level == INSTRUCTION:
            return {
                "instruction": InstructionConfig(target=site.target, seed=Stream.FAULT.seed(*drawn))
            }
        whole = site.field == INTEGER
        for number in range(_DRAWS):
            fault = FaultConfig(
                target=site.target,
                field=Field.ANY.value if whole else site.field,
                seed=Stream.FAULT.seed(*drawn, number),
            )
            # Redraw until the state has the required type; all such states are equally likely.
            if (fault.draw().states[0].dtype is DType.FLOAT64) is not whole:
                return {"fault": fault}
        raise ConfigError(f"no state of the stage {site.target} has the bit field {site.field}")


def evaluate(
    plan: EvaluationPlan, folder: Path, options: Options, spectator: Spectator
) -> tuple[Evaluation, tuple[pa.Table, pa.Table]]:
    """Fly the missions of a plan that have no result in `folder` yet, and evaluate the detectors.

    If the folder holds the flights of a smaller plan of the same kind, they are used again.

    Returns:
        The evaluation, and the two tables of pairs from which it is computed: pairs without a
        fault, and pairs with one.

    Raises:
        UnknownName, VehicleProcessError: a world or platform does not exist.
        ModelError: a model cannot be used, or was fitted to a flight with one of these seeds.
        ConfigError: the folder was flown with other versions of mavfi or its libraries.
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    plan.require_held_out()
    for world in plan.worlds:
        check_names(replace(plan.base, world=world, seed=plan.first_seed))
    spectator.on_note("flights without detectors")
    profiles = folder / BARE / PROFILES  # of the golden flights, which all detectors share
    options = replace(options, profiles=profiles)
    tables = [fly(plan.missions(), folder / BARE, Keep.ALL, options, spectator)]
    _, faults = pairs_of([flown(tables[0])], [NONE], plan.complete)
    names = ["world", "seed", "stage", "target", "field"]
    harm = {tuple(row.values()) for row in harmful(faults).select(names).to_pylist()}
    for detector in plan.protectors:
        spectator.on_note(f"the same with {detector}")
        # One folder for each model, whatever the name of its file.
        digest = plan.detector_config(detector).model_digest(plan.base.stack)
        place = folder / PROTECTED / f"{detector}-{digest[:12]}"
        missions = plan.missions(detector, harm)
        tables.append(fly(missions, place, Keep.NONE, options, spectator))
    shutil.rmtree(profiles, ignore_errors=True)
    pairs = pairs_of(map(flown, tables), (NONE, *plan.protectors), plan.complete)
    detectors = [plan.detector_config(name) for name in plan.protectors]
    scores = scored(detectors, plan.base.stack, folder, pairs, spectator.on_note)
    spectator.on_note("counting")
    failed = [text for table in tables for text in errors(table, "{labels}: {reason}")]
    return evaluation_of(plan, pairs, failed, scores), pairs


def evaluation_of(
    plan: EvaluationPlan, pairs: tuple[pa.Table, pa.Table], errors: Sequence[str], scored: Scored
) -> Evaluation:
    """Compute the evaluation of a plan from its pairs of flights.

    Args:
        pairs: as `analysis.detectors.pairs_of` returns them.
        errors: labels and reason of each mission that could not begin.
        scored: see `analysis.detectors.results`.
    """
    return results(
        (NONE, *plan.protectors), *pairs, scored, schema=SCHEMA, plan=plan.described(),
        versions=installed_versions(), errors=[*errors],
    )  # fmt: skip
