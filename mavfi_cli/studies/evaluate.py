"""`mavfi detect evaluate`: evaluate detectors on missions outside the training data.

The folder contains the campaign `bare` without detectors, and in `protected` one campaign for each
model of a detector. `bare` keeps its traces, because detectors are replayed on them. `protected`
keeps only records. The missions with detectors depend on the faults that do harm without them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.detector_pairs import NONE, Harm, pairs_of
from mavfi_cli.analysis.detectors import Scored, found
from mavfi_cli.analysis.flights import chosen, flights, flown, rows_of
from mavfi_cli.analysis.scores import Scores, model_digest
from mavfi_cli.campaign.begin import ask_vehicle
from mavfi_cli.campaign.factors import check_names
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import ResultState
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import PROFILES, Options, fly_missing, store_plan
from mavfi_cli.campaign.specification import Keep
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.versions import installed_versions
from mavfi_cli.studies.evaluation_plan import EvaluationPlan, Fault, require_held_out

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
    rows = (row for table in tables for row in rows_of(table, ["labels", "state", "reason"]))
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
        """Scores of the harmful faults, and of the golden flights."""
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
        errors: why missions could not be flown.
        scored: see `analysis.detectors.found`.
    """
    return {
        "schema": SCHEMA,
        "plan": plan.told(),
        "versions": installed_versions(),
        "errors": list(errors),
        **found((NONE, *plan.protectors), *pairs, scored),
    }
