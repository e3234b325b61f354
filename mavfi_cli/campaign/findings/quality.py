"""Quality of flight by setting: means with their intervals, and how far the flights spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mavfi_cli.campaign.findings.comparison import RESAMPLES, Comparison, against_golden
from mavfi_cli.campaign.findings.groups import METRICS, Group
from mavfi_cli.campaign.findings.setting_columns import SettingColumns
from mavfi_cli.stats.bootstrap import Interval, interval

_TITLES = {
    "flight_time_s": ("flight time, s", 1.0),
    "distance_m": ("distance, m", 1.0),
    "energy_regression_j": ("energy (paper's regression), kJ", 1e-3),
    "replans": ("replans", 1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """One metric of one setting, over its successful missions.

    Attributes:
        name: of the setting in one phrase.
        mean: with its bootstrap interval.
        least, median, most: of the flights; not a number where there are none.
        difference: to the golden flights of the same missions, with its bootstrap interval; None
            of golden settings.
    """

    labels: Mapping[str, Any]
    name: str
    metric: str
    mean: Interval
    least: float
    median: float
    most: float
    difference: Interval | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def qualities(groups: Sequence[Group], confidence: float = 0.95) -> list[Quality]:
    """Every metric of every setting, metric by metric."""
    beside = {each.name: each for each in against_golden(groups, confidence)}
    return [
        _quality(group, metric, beside.get(group.name), confidence)
        for metric in METRICS
        for group in groups
    ]


def _quality(group: Group, metric: str, compared: Comparison | None, confidence: float) -> Quality:
    values = group.successes(metric)
    quantiles = np.quantile(values, (0.0, 0.5, 1.0)) if len(values) else np.full(3, np.nan)
    least, median, most = quantiles.tolist()
    return Quality(
        labels=group.labels,
        name=group.name,
        metric=metric,
        mean=interval(values, confidence=confidence, resamples=RESAMPLES),
        least=least,
        median=median,
        most=most,
        difference=None if compared is None else compared.differences[metric],
    )


def lines(found: Sequence[Quality], confidence: float = 0.95) -> list[str]:
    """A table for each metric."""
    if not found:
        return []
    settings = SettingColumns.of([each.labels for each in found if each.metric == METRICS[0]])
    head = ["flights", f"mean ({100 * confidence:g} % interval)", "least", "median", "most",
            "to golden"]  # fmt: skip
    told = []
    for metric, (title, scale) in _TITLES.items():
        rows = [
            (each.labels, each.name, _cells(each, scale)) for each in found if each.metric == metric
        ]
        told += ["", title, *settings.table(head, rows)]
    return told


def _cells(each: Quality, scale: float) -> list[str]:
    difference = each.difference
    return [
        f"{each.mean.count}",
        _with_ends(each.mean, scale),
        *(_number(value, scale) for value in (each.least, each.median, each.most)),
        "" if difference is None else _with_ends(difference, scale, "+"),
    ]


def _number(value: float, scale: float, sign: str = "") -> str:
    return "-" if np.isnan(value) else format(scale * value, sign + ".2f")


def _with_ends(found: Interval, scale: float, sign: str = "") -> str:
    """A value and its interval, where there is one."""
    value, *ends = (_number(each, scale, sign) for each in (found.value, found.low, found.high))
    return value if "-" in ends else f"{value} ({' to '.join(ends)})"
