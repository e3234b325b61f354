"""`mavfi detect evaluate`: evaluate detectors on missions outside the training data.

The folder contains the campaign `bare` without detectors, and in `protected` one campaign for each
model of a detector. `bare` keeps its traces, because detectors are replayed on them. `protected`
keeps only records. The missions with detectors depend on the faults that do harm without them.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.detector_pairs import ERROR_FREE, FAULT, NONE, Harm, pairs_of
from mavfi_cli.analysis.detectors import Scored, found
from mavfi_cli.analysis.flights import chosen, flights, flown
from mavfi_cli.analysis.scores import Scores, model_digest
from mavfi_cli.campaigns.begin import ask_vehicle
from mavfi_cli.campaigns.factors import check_names
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Label, PlannedMission, ResultState, changes_of
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import PROFILES, Options, fly_missing, store_plan
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.config import require_distinct
from mavfi_cli.core.errors import ConfigError, ModelError, RecordError, UnknownName
from mavfi_cli.core.seeds import Stream, derive
from mavfi_cli.core.states import DType
from mavfi_cli.core.types import Stage
from mavfi_cli.core.versions import installed_versions
from mavfi_cli.detect import model as model_file
from mavfi_cli.detect.base import detector_names
from mavfi_cli.detect.model import training_flights
from mavfi_cli.fi.bits import Field
from mavfi_cli.spec.detector import STAGES, DetectorConfig, detector_of, model_path
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.instruction import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

WORLDS = ("sparse", "dense", "factory", "farm")
DETECTORS = (NONE, "range", "l2", "gad", "aad")
INTEGER = "integer"  # all bits of states that have no sign, exponent and mantissa
FIELDS = (Field.SIGN.value, Field.EXPONENT.value, Field.MANTISSA.value, INTEGER)
NODES = {
    "octomap": Stage.PERCEPTION,
    "collision_check": Stage.PERCEPTION,
    "point_cloud": Stage.PERCEPTION,
    "planner": Stage.PLANNING,
    "control": Stage.CONTROL,
}
SOURCE, INSTRUCTION = "source", "instruction"
_DRAWS = 1000  # number of fault seeds to try until one draws a state of the required type


@dataclass(frozen=True, slots=True, kw_only=True)
class _InjectionSite:
    """Injection site of one kind of fault.

    Attributes:
        stage: stage of the corrupted kernel or of its output.
        target: a stage, or a node.
        field: a bit field, `integer`, or `any`.
    """

    stage: str
    target: str
    field: str


Fault = tuple[str, int, _InjectionSite]  # world, seed of the mission, where


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
        if self.harmless_flights < 0:
            raise ConfigError(
                f"must not be negative, got {self.harmless_flights}", key="harmless flights"
            )
        if self.flights < 0 or self.golden_flights < max(1, self.flights):
            raise ConfigError(
                f"needs at least one error-free flight and one for each with a fault, got "
                f"{self.golden_flights} and {self.flights}",
                key="golden flights",
            )
        _require_some("level", (self.level,), (SOURCE, INSTRUCTION))
        _require_some("world", self.worlds, self.worlds)
        _require_some("detector", self.detectors, (NONE, *detector_names()))
        _require_some("stage", self.protect, STAGES)
        _require_some("field", self.fields, FIELDS)

    @property
    def protectors(self) -> tuple[str, ...]:
        """The detectors without `none`."""
        return tuple(name for name in self.detectors if name != NONE)

    def detector_config(self, detector: str) -> DetectorConfig:
        """Configuration of a detector for missions.

        Raises:
            ModelError: the folder of models has no such file.
        """
        path = None if self.models is None else self.models.absolute() / f"{detector}.json"
        if path is not None and not path.is_file():
            raise ModelError("no such model file", path=path)
        return DetectorConfig(
            name=detector, protect=self.protect, model=None if path is None else str(path)
        )

    @property
    def seeds(self) -> range:
        """Seeds of the missions, equal in each world; the first `flights` of them get faults."""
        return range(self.first_seed, self.first_seed + self.golden_flights)

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
            "places": [asdict(place) for place in self.places()],
            "mission": changes_of(self.base),
            **{name: getattr(self, name) for name in ("level", "flights", "harmless_flights",
                                                      "golden_flights", "first_seed", "seed")},
        }  # fmt: skip

    def places(self) -> list[_InjectionSite]:
        """Injection sites: stages by bit field, or nodes."""
        if self.level == INSTRUCTION:
            return [
                _InjectionSite(stage=stage.value, target=node, field=Field.ANY.value)
                for node, stage in NODES.items()
            ]
        return [
            _InjectionSite(stage=stage.value, target=stage.value, field=name)
            for stage, name in itertools.product(Stage, self.fields)
            if stage is not Stage.CONTROL or name != INTEGER  # its states are all float64
        ]

    def bare(self) -> list[PlannedMission]:
        """Golden flights, then flights with a fault, all without detector."""
        return [self._mission(key) for key in self._keys()]

    def protected(self, detector: str, harmful: Collection[Fault]) -> list[PlannedMission]:
        """The same flights with a detector.

        Args:
            harmful: faults that do harm without detector.
        """
        return [
            self._mission(key, detector)
            for key in self._keys()
            if key[2] is None or self.complete(key[1]) or (*key[:2], key[2]) in harmful
        ]

    def complete(self, seed: int) -> bool:
        """Whether the detectors fly all faults of this mission, including harmless ones."""
        return seed in self.seeds[: self.harmless_flights]

    def _keys(self) -> Iterator[tuple[str, int, _InjectionSite | None]]:
        for world, seed in itertools.product(self.worlds, self.seeds):
            yield world, seed, None
        faulty = self.seeds[: self.flights]
        yield from itertools.product(self.worlds, faulty, self.places())

    def _mission(
        self, key: tuple[str, int, _InjectionSite | None], detector: str = NONE
    ) -> PlannedMission:
        world, seed, place = key
        config = replace(self.base, world=world, seed=seed)
        labels: dict[str, Label] = {
            "kind": FAULT, "world": world, "seed": seed, "detector": detector
        }  # fmt: skip
        if place is None:
            labels["kind"] = ERROR_FREE
        else:
            config = replace(config, **self._fault(world, seed, place))
            labels |= {"level": self.level, "stage": place.stage, "target": place.target,
                       "field": place.field}  # fmt: skip
        if detector != NONE:
            config = replace(config, detector=self.detector_config(detector))
        return PlannedMission(config=config, labels=labels)

    def _fault(self, world: str, seed: int, place: _InjectionSite) -> dict[str, Any]:
        drawn = (self.seed, Stream.FAULT, "evaluation", world, seed, place.target, place.field)
        if self.level == INSTRUCTION:
            return {"instruction": InstructionConfig(target=place.target, seed=derive(*drawn))}
        whole = place.field == INTEGER
        for number in range(_DRAWS):
            fault = FaultConfig(
                target=place.target,
                field=Field.ANY.value if whole else place.field,
                seed=derive(*drawn, number),
            )
            # Draw again until the state has the required type: all of them are equally likely.
            if (fault.draw().states[0].dtype is DType.FLOAT64) is not whole:
                return {"fault": fault}
        raise ConfigError(f"no state of {place.target} has a bit field {place.field}")


def _require_some(what: str, chosen: Sequence[str], known: Sequence[str]) -> None:
    if not chosen:
        raise ConfigError("none is named", key=what)
    for name in chosen:
        if name not in known:
            raise UnknownName(what, name, known)
    require_distinct(chosen, what)


def require_held_out(plan: EvaluationPlan) -> None:
    """Reject detectors that cannot be loaded, and missions that trained a model.

    Seeds are compared across worlds, because two worlds may use the same random numbers.

    Raises:
        ModelError: a model cannot be used; the message names the training flight.
    """
    for detector in map(plan.detector_config, plan.protectors):
        detector_of(detector, plan.base.stack)
        path = model_path(detector, plan.base.stack)
        for flight in () if path is None else training_flights(model_file.provenance(path)):
            seed = flight.rpartition("/")[2]
            if seed.isdigit() and int(seed) in plan.seeds:
                raise ModelError(
                    f"{detector.name} was made with the flight {flight}: seeds {plan.seeds.start} "
                    f"to {plan.seeds.stop - 1} are not held out, choose another --first-seed",
                    path=path,
                )


SCHEMA = 1
BARE, PROTECTED = "bare", "protected"


def evaluate(
    plan: EvaluationPlan, folder: Path, options: Options, spectator: Spectator
) -> tuple[dict[str, Any], tuple[pa.Table, pa.Table]]:
    """Fly the missing missions of the folder, and evaluate the detectors.

    A larger plan of the same kind extends a smaller one.

    Returns:
        The contents of `evaluation.json`, and its pairs: without faults, and with one.

    Raises:
        UnknownName, VehicleProcessError: a world or platform that does not exist.
        ModelError: a model that cannot be used, or that was made with one of these seeds.
        ConfigError: other versions of mavfi or its libraries flew in the folder.
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    require_held_out(plan)
    for world in plan.worlds:
        check_names(replace(plan.base, world=world, seed=plan.first_seed), ask_vehicle)
    spectator.on_note("flights without detectors")
    with Ledger(folder / BARE, writing=True) as ledger:
        store_plan(ledger, plan.bare(), append=True)
        fly_missing(ledger, replace(options, keep=Keep.ALL), spectator)
        tables = [flights(ledger, plan.bare())]
    harmful = _harmful(plan, tables[0])
    for detector in plan.protectors:
        spectator.on_note(f"the same with {detector}")
        missions = plan.protected(detector, harmful)
        with Ledger(_protected_folder(plan, folder, detector), writing=True) as ledger:
            store_plan(ledger, missions, append=True)
            _share_profiles(folder, ledger.folder)
            fly_missing(ledger, replace(options, keep=Keep.NONE), spectator)
            tables.append(flights(ledger, missions))
    pairs = pairs_of(map(flown, tables), (NONE, *plan.protectors), plan.complete)
    detectors = [plan.detector_config(name) for name in plan.protectors]
    scores = Scores(detectors, plan.base.stack, folder)
    scored = _scored(scores, *pairs, spectator)
    spectator.on_note("counting")
    return told(plan, pairs, _errors(tables), scored), pairs


def _protected_folder(plan: EvaluationPlan, folder: Path, detector: str) -> Path:
    """Folder of the flights with a detector: one per model, independent of its file name."""
    digest = model_digest(plan.detector_config(detector), plan.base.stack)
    return folder / PROTECTED / f"{detector}-{digest[:12]}"


def _share_profiles(folder: Path, protected: Path) -> None:
    """Share the profiles of the bare flights, which have the same golden flight."""
    try:
        if not (protected / PROFILES).exists():
            (protected / PROFILES).symlink_to(Path("..") / ".." / BARE / PROFILES)
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror or error}") from None


def _harmful(plan: EvaluationPlan, bare: pa.Table) -> set[Fault]:
    """Faults that did harm without a detector."""
    places = {(place.target, place.field): place for place in plan.places()}
    _, faults = pairs_of([flown(bare)], [NONE], plan.complete)
    return {
        (row["world"], row["seed"], places[row["target"], row["field"]])
        for row in _active_harm(faults).to_pylist()
    }


def _active_harm(faults: pa.Table) -> pa.Table:
    active = chosen(faults, active=True, detector=NONE)
    return active.filter(pc.not_equal(active["harm"], Harm.NONE.value))


def _errors(tables: Iterable[pa.Table]) -> list[str]:
    names = ["labels", "state", "reason"]
    rows = (row for table in tables for row in table.select(names).to_pylist())
    return [
        f"{row['labels']}: {row['reason']}"
        for row in rows
        if row["state"] == ResultState.ERROR.value
    ]


def _scored(scores: Scores, error_free: pa.Table, faults: pa.Table, view: Spectator) -> Scored:
    """Scores of the harmful faults and of the error-free flights, by detector."""
    harmful = _active_harm(faults)
    golden = chosen(error_free, detector=NONE)["golden_path"].to_pylist()
    struck = harmful["faulty_path"].to_pylist()
    struck_s = harmful["faulty_struck_s"].to_pylist()
    wanted = itertools.chain(zip(struck, struck_s, strict=True), ((path, None) for path in golden))
    scores.score_all(wanted, view.on_note)

    def of(detector: str) -> tuple[pa.Table, list[float]]:
        positive = pa.array([scores.of(path, detector) for path in struck], pa.float64())
        table = harmful.select(["stage", "field"]).append_column("score", positive)
        negative = (scores.of(path, detector) for path in golden)
        return table.drop_null(), [score for score in negative if score is not None]

    return of


def told(
    plan: EvaluationPlan, pairs: tuple[pa.Table, pa.Table], errors: Sequence[str], scored: Scored
) -> dict[str, Any]:
    """Results of these pairs, as plain values.

    Args:
        scored: see `analysis.detectors.found`.
    """
    return {
        "schema": SCHEMA,
        "plan": plan.told(),
        "versions": installed_versions(),
        "errors": list(errors),
        **found((NONE, *plan.protectors), *pairs, scored),
    }
