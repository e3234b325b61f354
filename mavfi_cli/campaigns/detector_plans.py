"""The missions of detectors: those to which they are fitted, and those that evaluate them.

Models are fitted to the paper's training set (section VI): two obstacle densities times two
obstacle sizes, 25 error-free flights each. Every flight has its own world seed. An evaluation flies
golden missions, the same with faults, and the same with faults and detectors.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from mavfi_cli.campaigns.missions import Label, PlannedMission, changes_of
from mavfi_cli.campaigns.specification import require_named
from mavfi_cli.core.errors import ConfigError, ModelError
from mavfi_cli.core.files import file_digest
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import DType, Stage
from mavfi_cli.detect.base import PLUG_INS, Model
from mavfi_cli.detect.fit import KINDS
from mavfi_cli.fi.bits import Field
from mavfi_cli.spec.detector import STAGES, DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

TRAINING_WORLDS = ("train-0.05-3", "train-0.05-5", "train-0.2-3", "train-0.2-5")
WORLDS = ("sparse", "dense", "factory", "farm")  # of an evaluation
NONE = "none"  # no detector: the reference of all others
DETECTORS = (NONE, "range", "l2", "gad", "aad")
ERROR_FREE, FAULT = "error-free", "fault"  # kinds of missions


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

    worlds: tuple[str, ...] = TRAINING_WORLDS
    flights: int = 25
    first_seed: int = 10_000  # far from the usual seeds of flights and evaluations
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


INTEGER = "integer"  # all bits of states that have no sign, exponent and mantissa
FIELDS = (Field.SIGN.value, Field.EXPONENT.value, Field.MANTISSA.value, INTEGER)
_NODES = {
    "octomap": Stage.PERCEPTION,
    "collision_check": Stage.PERCEPTION,
    "point_cloud": Stage.PERCEPTION,
    "planner": Stage.PLANNING,
    "control": Stage.CONTROL,
}
SOURCE, INSTRUCTION = "source", "instruction"
_DRAWS = 1000  # number of fault seeds to try until one draws a state of the required type


class _Site(NamedTuple):
    stage: str  # of the corrupted kernel or of its output
    target: str  # a stage, or a node
    field: str  # a bit field, `integer`, or `any`


def model_digest(detector: DetectorConfig, stack: str) -> str:
    """Digest of a detector's model file; `none` without one."""
    path = detector.model_path(stack)
    return "none" if path is None else file_digest(path)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationPlan:
    """Plan of an evaluation.

    Attributes:
        detectors: names; `none` is always flown, named or not.
        flights: missions per world that are flown with a fault at each site, one per flight.
        harmless_flights: number of them, from the first on, whose faults are all flown with the
            detectors; only harmful faults of the others are.
        golden_flights: error-free missions per world; the first ones also get faults.
        first_seed: seeds of missions count up from here; training flies from 10 000 on.
        models: folder of model files `NAME.json`; None takes those shipped for the stack of `base`.
        level: source or instruction.
        fields: fields of the bits at source level.
        seed: root of the faults' seeds.
        base: the other parameters of all missions.

    Raises:
        ConfigError, UnknownName: a name is missing, unknown or named twice.
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
        """The detectors without `none`."""
        return tuple(name for name in self.detectors if name != NONE)

    @property
    def seeds(self) -> range:
        """Seeds of the missions, equal in each world; the first `flights` of them get faults."""
        return range(self.first_seed, self.first_seed + self.golden_flights)

    def complete(self, seed: int) -> bool:
        """Whether the detectors fly all faults of this mission, including harmless ones."""
        return seed in self.seeds[: self.harmless_flights]

    def detector_config(self, detector: str) -> DetectorConfig:
        """Configuration of a detector for missions.

        Raises:
            ModelError: the folder of models has no such file.
        """
        return DetectorConfig.with_model(detector, self.models, self.protect)

    def require_held_out(self) -> None:
        """Reject detectors that cannot be loaded, and missions that trained a model.

        Seeds are compared across worlds, because two worlds may use the same random numbers.

        Raises:
            ModelError: a model cannot be used; the message names the training flight.
        """
        for detector in map(self.detector_config, self.protectors):
            detector.built(self.base.stack)
            path = detector.model_path(self.base.stack)
            for flight in () if path is None else Model.read(path).training_flights:
                seed = flight.rpartition("/")[2]
                if seed.isdigit() and int(seed) in self.seeds:
                    raise ModelError(
                        f"{detector.name} was made with the flight {flight}: seeds "
                        f"{self.seeds.start} to {self.seeds.stop - 1} are not held out, choose "
                        "another --first-seed",
                        path=path,
                    )

    def told(self) -> dict[str, Any]:
        """The plan, with descriptions of the detectors, as plain values."""
        stack = self.base.stack
        return {
            "worlds": list(self.worlds),
            "detectors": {
                each.name: {
                    "threshold": each.built(stack).threshold,
                    "model_sha256": model_digest(each, stack),
                }
                for each in map(self.detector_config, self.protectors)
            },
            "protect": list(self.protect),
            "places": [place._asdict() for place in self.places()],
            "mission": changes_of(self.base),
            **{name: getattr(self, name) for name in ("level", "flights", "harmless_flights",
                                                      "golden_flights", "first_seed", "seed")},
        }  # fmt: skip

    def places(self) -> list[_Site]:
        """Stages by bit field at source level, nodes at instruction level."""
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
        """Golden flights, then flights with a fault, with a detector or without.

        Args:
            harmful: world, seed, stage, target and field of the faults that do harm without a
                detector. Detectors fly these, and all faults of complete missions.
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
            # Draw again until the state has the required type: all of them are equally likely.
            if (fault.draw().states[0].dtype is DType.FLOAT64) is not whole:
                return {"fault": fault}
        raise ConfigError(f"no state of {site.target} has a bit field {site.field}")
