"""Traces of unprotected flights once more through the detectors: one score a flight.

The score is the highest of the flight's messages, in units of the detector's threshold: above 1
the gate would have raised an alarm. Nothing is withheld on the way, so the scores do not depend on
the threshold (but what a gate says of plans on their arrival is not in a trace).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path

from mavfi_cli.campaign.evaluation.fly import model_digest
from mavfi_cli.campaign.evaluation.pairs import Flown
from mavfi_cli.campaign.evaluation.plan import EvaluationPlan
from mavfi_cli.core.files import write_json
from mavfi_cli.core.types import Stage
from mavfi_cli.detect.model import preprocessing
from mavfi_cli.detect.offline import Columns, columns_of, replay
from mavfi_cli.detect.registry import find
from mavfi_cli.mission.run_folder import load_run

SCORES = "scores.json"


class Scores:
    """Scores of flights by detector; what was scored once is kept in the folder."""

    def __init__(self, plan: EvaluationPlan, folder: Path) -> None:
        self._plan = plan
        self._path = folder / SCORES
        protect = "+".join(sorted(plan.protect))
        self._names = {
            name: f"{name}/{protect}/{model_digest(plan, name)}" for name in plan.protectors
        }
        self._kept: dict[str, dict[str, float | None]] = _read(self._path)

    def score_all(self, flights: Iterable[Flown], tell: Callable[[str], None]) -> None:
        """Score what was not scored yet; flights without a trace are passed over."""
        missing = [
            flown
            for flown in flights
            if flown.path is not None
            and any(flown.path.name not in self._kept.get(n, {}) for n in self._names.values())
        ]
        if not missing:
            return
        tell(f"replaying {len(missing)} flights through {len(self._names)} detectors")
        for flown in missing:
            assert flown.path is not None
            trace = load_run(flown.path).trace
            columns = {} if trace is None else columns_of(trace)
            for detector, name in self._names.items():
                kept = self._kept.setdefault(name, {})
                if flown.path.name not in kept:
                    kept[flown.path.name] = self._score(columns, flown.struck_s, detector)
        write_json(self._path, self._kept)

    def of(self, flown: Flown, detector: str) -> float | None:
        """The score of a flight; None where it has no trace. A score that is NaN is an alarm."""
        kept = self._kept.get(self._names[detector], {})
        if flown.path is None or flown.path.name not in kept:
            return None
        score = kept[flown.path.name]
        return math.inf if score is None else score

    def _score(self, columns: Columns, struck_s: float | None, detector: str) -> float:
        """The highest score from the strike on, or of the whole flight without one."""
        if not columns:  # it ended before the first tick
            return 0.0
        path = self._plan.model_path(detector)
        fresh = find(detector, model=path if self._plan.models is not None else None)
        protect = frozenset(Stage(name) for name in self._plan.protect)
        params = None if path is None else preprocessing(path)
        from_s = -math.inf if struck_s is None else struck_s - 1e-9
        highest = 0.0
        for judged in replay(columns, fresh, params, protect=protect):
            if judged.stamp_s >= from_s and not judged.score <= highest:
                highest = judged.score
                if math.isnan(highest):
                    return math.inf
        return highest / fresh.threshold


def _read(path: Path) -> dict[str, dict[str, float | None]]:
    """What was kept; damaged or missing, nothing."""
    try:
        kept: dict[str, dict[str, float | None]] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return kept
