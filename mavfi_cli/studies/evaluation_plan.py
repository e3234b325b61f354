"""The missions of `mavfi detect evaluate`: golden, with faults, and with detectors."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.detector_pairs import ERROR_FREE, FAULT, NONE
from mavfi_cli.analysis.scores import model_digest
from mavfi_cli.campaigns.missions import Label, PlannedMission, changes_of
from mavfi_cli.detect.base import detector_names
from mavfi_cli.spec.detector import STAGES, DetectorConfig, detector_of, detector_with_model
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.studies.evaluation_sites import (
    FIELDS,
    INSTRUCTION,
    SOURCE,
    InjectionSite,
    fault_at,
    sites,
)
from mavfi_cli.studies.flying import require_named

WORLDS = ("sparse", "dense", "factory", "farm")
DETECTORS = (NONE, "range", "l2", "gad", "aad")


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
        require_named("detector", self.detectors, (NONE, *detector_names()))
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
        return detector_with_model(detector, self.models, self.protect)

    def told(self) -> dict[str, Any]:
        """The plan, with descriptions of the detectors, as plain values."""
        stack = self.base.stack
        return {
            "worlds": list(self.worlds),
            "detectors": {
                each.name: {
                    "threshold": detector_of(each, stack).threshold,
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

    def places(self) -> list[InjectionSite]:
        """Injection sites: stages by bit field, or nodes."""
        return sites(self.level, self.fields)

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

    def _mission(
        self, world: str, seed: int, place: InjectionSite | None, detector: str
    ) -> PlannedMission:
        kind = ERROR_FREE if place is None else FAULT
        labels: dict[str, Label] = {
            "kind": kind, "world": world, "seed": seed, "detector": detector
        }  # fmt: skip
        config = replace(self.base, world=world, seed=seed)
        if place is not None:
            fault = fault_at(place, self.level, self.seed, world, seed)
            config = replace(config, **fault)
            labels |= {"level": self.level, **place._asdict()}
        if detector != NONE:
            config = replace(config, detector=self.detector_config(detector))
        return PlannedMission(config=config, labels=labels)
