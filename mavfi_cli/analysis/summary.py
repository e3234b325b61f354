"""Summary of a campaign: settings, cost of faults, benefit of protection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from mavfi_cli.analysis.comparison import against_golden, protection
from mavfi_cli.analysis.groups import INACTIVE, METRICS, RESAMPLES, Group, groups
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import COUNTED
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.shares import rate


def summarise(ledger: Ledger, by: Sequence[str] = (), confidence: float = 0.95) -> dict[str, Any]:
    """Summarise the flown missions of a ledger.

    Args:
        by: labels by which settings are grouped; empty means all.

    Returns:
        Plain values. `cells`: one row per setting. `faults`, `protection`: see `comparison`.

    Raises:
        UnknownName: no setting has such a label.
    """
    found = groups(ledger, by)
    missions, over = ledger.planned(), ledger.over()
    return {
        "name": ledger.meta("name") or ledger.folder.name,
        "missions": missions,
        "over": over,
        "confidence": confidence,
        "cells": [_cell(group, confidence) for group in found],
        "faults": against_golden(found, confidence),
        "protection": protection(found, confidence),
        "missing": missions - over,
    }


def _cell(group: Group, confidence: float) -> dict[str, Any]:
    """One setting.

    Returns:
        `name`: its labels in one phrase. `planned`: missions on the list; `errors`: that could not
        begin. `outcomes`: how the flown ones ended. `injected`: what became of the faults.
        `success`: over golden missions and faults that struck; faults that were not injected or
        not activated are in `inactive` only. `every`: success over all flown missions, as the
        paper counts. `metrics`: of the successful ones among those of `success`, means with
        bootstrap intervals.
    """

    def success(fates: frozenset[str]) -> dict[str, Any]:
        """Success rate over the selected missions."""
        chosen = group.succeeded[group.among("injected", fates)]
        return asdict(rate(int(chosen.sum()), len(chosen), confidence))

    return {
        "labels": group.labels,
        "name": group.name,
        "planned": group.planned,
        "errors": group.errors,
        "outcomes": group.counts("outcome"),
        "injected": group.counts("injected"),
        "success": success(COUNTED),
        "inactive": success(INACTIVE),
        "every": success(COUNTED | INACTIVE),
        "metrics": {name: _mean(group, name, confidence) for name in METRICS},
    }


def _mean(group: Group, metric: str, confidence: float) -> dict[str, Any]:
    """A metric over the successful missions, with its bootstrap interval."""
    values = group.successes(metric)
    return asdict(interval(values, confidence=confidence, resamples=RESAMPLES))


def qualities(groups: Sequence[Group], confidence: float = 0.95) -> list[dict[str, Any]]:
    """Every metric of every setting over its successful missions, metric by metric.

    Returns:
        Plain values. `name`: of the setting in one phrase. `mean`: with its bootstrap interval.
        `least`, `median`, `most`: of the flights; not a number where there are none. `difference`:
        to the golden flights of the same missions, with its bootstrap interval; None of golden
        settings.
    """
    beside = {each["name"]: each["differences"] for each in against_golden(groups, confidence)}
    rows = []
    for metric in METRICS:
        for group in groups:
            values = group.successes(metric)
            ends = np.quantile(values, (0.0, 0.5, 1.0)) if len(values) else np.full(3, np.nan)
            least, middle, most = ends.tolist()
            rows.append(
                {
                    "labels": group.labels,
                    "name": group.name,
                    "metric": metric,
                    "mean": _mean(group, metric, confidence),
                    "least": least,
                    "median": middle,
                    "most": most,
                    "difference": beside.get(group.name, {}).get(metric),
                }
            )
    return rows
