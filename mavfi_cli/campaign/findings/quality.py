"""Quality of flight by setting: means with their intervals, and how far the flights spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mavfi_cli.campaign.findings.comparison import RESAMPLES, Comparison, against_golden
from mavfi_cli.campaign.findings.groups import METRICS, Group
from mavfi_cli.campaign.statistics.bootstrap import Interval, interval

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
    width = max((len(each.name) for each in found), default=0)
    width = max(width, *(len(title) for title, _ in _TITLES.values()))
    sure = f"{100 * confidence:g} % interval"
    told = []
    for metric, (title, scale) in _TITLES.items():
        told += ["", f"{title:<{width}}  {'flights':>7}  {'mean':>8}  {sure:>20}  {'least':>8}  "
                 f"{'median':>8}  {'most':>8}  {'to golden':>9}  {sure:>20}"]  # fmt: skip
        told += [_line(each, width, scale) for each in found if each.metric == metric]
    return told


def _line(each: Quality, width: int, scale: float) -> str:
    mean, difference = each.mean, each.difference
    cells = [f"{mean.count:>7}", _number(mean.value, scale), _ends(mean, scale)]
    cells += [_number(value, scale) for value in (each.least, each.median, each.most)]
    if difference is not None:
        cells += [f"{_number(difference.value, scale, '+'):>9}", _ends(difference, scale, "+")]
    return "  ".join([f"{each.name:<{width}}", *cells])


def _number(value: float, scale: float, sign: str = "") -> str:
    return f"{'-' if np.isnan(value) else format(scale * value, sign + '.2f'):>8}"


def _ends(found: Interval, scale: float, sign: str = "") -> str:
    ends = (found.low, found.high)
    told = " to ".join(_number(end, scale, sign).strip() for end in ends)
    return f"{'-' if np.isnan(ends).any() else told:>20}"
