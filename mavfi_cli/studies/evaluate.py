"""`mavfi detect evaluate`: evaluate detectors on missions outside the training data.

The folder contains the campaign `bare` without detectors, and in `protected` one campaign for each
model of a detector. `bare` keeps its traces, because detectors are replayed on them. `protected`
keeps only records. The missions with detectors depend on the faults that do harm without them.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from mavfi_cli.analysis.detectors import Scored, found, harmful, pairs_of
from mavfi_cli.analysis.flights import errors, flown
from mavfi_cli.analysis.scores import scored
from mavfi_cli.campaigns.begin import check_names
from mavfi_cli.campaigns.detector_plans import NONE, EvaluationPlan, model_digest
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import PROFILES, Options
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.installed import installed_versions
from mavfi_cli.studies import fly

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
    plan.require_held_out()
    for world in plan.worlds:
        check_names(replace(plan.base, world=world, seed=plan.first_seed))
    spectator.on_note("flights without detectors")
    profiles = folder / BARE / PROFILES  # flights with detectors have the same golden flights
    options = replace(options, profiles=profiles)
    tables = [fly(plan.missions(), folder / BARE, Keep.ALL, options, spectator)]
    _, faults = pairs_of([flown(tables[0])], [NONE], plan.complete)
    names = ["world", "seed", "stage", "target", "field"]
    harm = {tuple(row.values()) for row in harmful(faults).select(names).to_pylist()}
    for detector in plan.protectors:
        spectator.on_note(f"the same with {detector}")
        # One folder for each model, whatever the name of its file.
        digest = model_digest(plan.detector_config(detector), plan.base.stack)
        place = folder / PROTECTED / f"{detector}-{digest[:12]}"
        missions = plan.missions(detector, harm)
        tables.append(fly(missions, place, Keep.NONE, options, spectator))
    shutil.rmtree(profiles, ignore_errors=True)
    pairs = pairs_of(map(flown, tables), (NONE, *plan.protectors), plan.complete)
    detectors = [plan.detector_config(name) for name in plan.protectors]
    scores = scored(detectors, plan.base.stack, folder, pairs, spectator.on_note)
    spectator.on_note("counting")
    failed = [text for table in tables for text in errors(table, "{labels}: {reason}")]
    return told(plan, pairs, failed, scores), pairs


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
