"""An evaluation as one table of plain values: what `evaluation.json` holds."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.evaluation.fly import fly, model_digest, read
from mavfi_cli.campaign.evaluation.metrics import (
    error_free_metrics,
    fault_metrics,
    recoveries_compared,
)
from mavfi_cli.campaign.evaluation.pairs import ErrorFree, FaultPair, Harm
from mavfi_cli.campaign.evaluation.plan import NONE, EvaluationPlan
from mavfi_cli.campaign.evaluation.scores import Scores
from mavfi_cli.campaign.missions import changes_of
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options
from mavfi_cli.mission.detector_config import detector_of
from mavfi_cli.mission.run import installed_versions
from mavfi_cli.stats.paired import holm
from mavfi_cli.stats.roc import curves

SCHEMA = 1
ALL = "all"
GROUPS = (ALL, "world", "stage", "field", "state")  # what faults are gathered by
Pairs = tuple[list[ErrorFree], list[FaultPair]]


def evaluate(
    plan: EvaluationPlan, folder: Path, options: Options, spectator: Spectator
) -> tuple[dict[str, Any], Pairs]:
    """Fly what is missing, and say what the detectors are worth.

    Returns:
        The evaluation, and the pairs that it counts.

    Raises:
        MavfiError: as `fly.fly`.
    """
    fly(plan, folder, options, spectator)
    flights, errors = read(plan, folder)
    pairs = flights.error_free(plan.everyone), flights.faults(plan.everyone, plan.complete)
    scores = Scores(plan, folder)
    spectator.on_note("counting")
    return summarise(plan, *pairs, errors, _scored(scores, *pairs, spectator)), pairs


def _scored(
    scores: Scores,
    error_free: Sequence[ErrorFree],
    faults: Sequence[FaultPair],
    spectator: Spectator,
) -> Callable[[str], tuple[list[tuple[FaultPair, float]], list[float]]]:
    """Scores of the harmful faults and of the error-free flights, by detector."""
    bare = [pair for pair in faults if pair.detector == NONE]
    harmful = [pair for pair in bare if pair.active and pair.harm is not Harm.NONE]
    golden = [pair.golden for pair in error_free if pair.detector == NONE]
    wanted = [pair.faulty for pair in harmful], golden
    scores.score_all(itertools.chain(*wanted), spectator.on_note)

    def of(detector: str) -> tuple[list[tuple[FaultPair, float]], list[float]]:
        """A detector's scores of harmful faults, each with its pair, and of error-free flights."""
        positive = [(pair, scores.of(pair.faulty, detector)) for pair in harmful]
        negative = [scores.of(flown, detector) for flown in wanted[1]]
        return (
            [(pair, score) for pair, score in positive if score is not None],
            [score for score in negative if score is not None],
        )

    return of


def summarise(
    plan: EvaluationPlan,
    error_free: Sequence[ErrorFree],
    faults: Sequence[FaultPair],
    errors: Sequence[str],
    scored: Callable[[str], tuple[list[tuple[FaultPair, float]], list[float]]],
) -> dict[str, Any]:
    """The evaluation of these pairs, a row a group and detector.

    Args:
        errors: why missions could not be flown.
        scored: scores of harmful faults and of error-free flights, by detector.
    """
    return {
        "schema": SCHEMA,
        "plan": _plan(plan),
        "versions": installed_versions(),
        "errors": list(errors),
        "error_free": [
            {"by": by, "value": value, "detector": detector, **asdict(error_free_metrics(chosen))}
            for by, value, detector, chosen in _grouped(plan, error_free, (ALL, "world"))
        ],
        "faults": [
            {
                "by": by,
                "value": value,
                "detector": detector,
                **asdict(fault_metrics(_bare(faults, by, value), chosen)),
            }
            for by, value, detector, chosen in _grouped(plan, faults, GROUPS)
        ],
        "comparisons": _comparisons(plan, faults),
        "curves": {name: _curves(*scored(name)) for name in plan.protectors},
    }


def _plan(plan: EvaluationPlan) -> dict[str, Any]:
    return {
        "worlds": list(plan.worlds),
        "detectors": {
            name: {
                "threshold": detector_of(plan.detector_config(name), plan.base.stack).threshold,
                "model_sha256": model_digest(plan, name),
            }
            for name in plan.protectors
        },
        "protect": list(plan.protect),
        "level": plan.level,
        "places": [asdict(place) for place in plan.places()],
        "flights": plan.flights,
        "harmless_flights": plan.harmless_flights,
        "golden_flights": plan.golden_flights,
        "first_seed": plan.first_seed,
        "seed": plan.seed,
        "mission": changes_of(plan.base),
    }


def _grouped(
    plan: EvaluationPlan, pairs: Sequence[Any], groups: Sequence[str]
) -> Iterator[tuple[str, str, str, list[Any]]]:
    """Group, its value, detector, and the pairs, in the order in which values first come."""
    for by in groups:
        values = dict.fromkeys(ALL if by == ALL else str(getattr(pair, by)) for pair in pairs)
        for value, detector in itertools.product(values, plan.everyone):
            chosen = [pair for pair in pairs if pair.detector == detector and _in(pair, by, value)]
            yield by, value, detector, chosen


def _in(pair: Any, by: str, value: str) -> bool:
    return by == ALL or str(getattr(pair, by)) == value


def _bare(faults: Sequence[FaultPair], by: str, value: str) -> list[FaultPair]:
    """The faults of a group without a detector."""
    return [pair for pair in faults if pair.detector == NONE and _in(pair, by, value)]


def _comparisons(plan: EvaluationPlan, faults: Sequence[FaultPair]) -> list[dict[str, Any]]:
    """Every two detectors on the same faults, with p-values corrected over all of them."""
    by_name = {name: [pair for pair in faults if pair.detector == name] for name in plan.everyone}
    rows: list[dict[str, Any]] = []
    for first, second in itertools.combinations(plan.everyone, 2):
        recovered, undone = recoveries_compared(by_name[first], by_name[second])
        rows.append(
            {
                "first": first,
                "second": second,
                "recovered": {**asdict(recovered), "difference": recovered.difference},
                "undone": {**asdict(undone), "difference": undone.difference},
            }
        )
    for what in ("recovered", "undone"):
        corrected = holm([row[what]["p_value"] for row in rows])
        for row, p_value in zip(rows, corrected, strict=True):
            row[what]["corrected_p"] = p_value
    return rows


def _curves(
    harmful: Sequence[tuple[FaultPair, float]], error_free: Sequence[float]
) -> dict[str, Any]:
    """Curves over all faults, and the areas of each stage and bit field."""
    table = asdict(curves([score for _, score in harmful], error_free))
    table["areas"] = []
    for by in ("stage", "field"):
        for value in dict.fromkeys(str(getattr(pair, by)) for pair, _ in harmful):
            chosen = [score for pair, score in harmful if str(getattr(pair, by)) == value]
            part = curves(chosen, error_free)
            table["areas"].append(
                {
                    "by": by, "value": value, "positives": part.positives, "area": part.area,
                    "area_low": part.area_low, "area_high": part.area_high,
                    "average_precision": part.average_precision,
                }
            )  # fmt: skip
    return table
