"""Outcomes of isolated runs, and proportions with their confidence intervals."""

from __future__ import annotations

import math
import signal
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any


class Outcome(Enum):
    """What one fault did to an isolated program or kernel."""

    BENIGN = "benign"
    CRASH = "crash"
    HANG = "hang"
    SDC = "sdc"
    NOT_INJECTED = "not_injected"

    @property
    def title(self) -> str:
        """What people call it."""
        return "SDC" if self is Outcome.SDC else self.value.replace("_", " ")


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A proportion with its Wilson score interval."""

    count: int
    total: int
    share: float
    low: float
    high: float


def wilson(
    count: int,
    total: int,
    *,
    design_effect: float = 1.0,
    confidence_z: float = 1.959963984540054,
) -> Share:
    """Wilson score interval (E. B. Wilson, JASA 22, 1927), 95 % by default.

    With no observation the interval is the whole of [0, 1] and the share is not a number. A design
    effect above 1 counts as that many times fewer observations.
    """
    if total == 0:
        return Share(count=0, total=0, share=math.nan, low=0.0, high=1.0)
    p, n = count / total, total / design_effect
    z2 = confidence_z**2
    centre = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = confidence_z * math.sqrt(p * (1 - p) / n + z2 / (4 * n**2)) / (1 + z2 / n)
    return Share(
        count=count,
        total=total,
        share=p,
        low=max(0.0, centre - half) if count else 0.0,
        high=min(1.0, centre + half) if count < total else 1.0,
    )


Window = tuple[Hashable, int]  # stratum and number of the sampled window that a run hit


def shares(
    outcomes: Iterable[Outcome], windows: Iterable[Window | None] = ()
) -> dict[Outcome, Share]:
    """Each outcome's share of the *injected* runs; not injected ones are a share of all runs.

    Args:
        outcomes: of the runs.
        windows: of each run, where its instruction is from a sample of windows; None for a run
            that stands for itself. Intervals are widened by the likeness of runs in a window.
    """
    ended = list(outcomes)
    hit = list(windows) or [None] * len(ended)
    injected = [(o, w) for o, w in zip(ended, hit, strict=True) if o is not Outcome.NOT_INJECTED]
    found = {}
    for outcome in Outcome:
        of = list(zip(ended, hit, strict=True)) if outcome is Outcome.NOT_INJECTED else injected
        is_it = [each is outcome for each, _ in of]
        effect = design_effect(is_it, [window for _, window in of])
        found[outcome] = wilson(sum(is_it), len(of), design_effect=effect)
    return found


def design_effect(hits: Sequence[bool], windows: Sequence[Window | None]) -> float:
    """How many times the variance of a share is that of as many independent runs; at least 1.

    Windows are clusters within strata (W. G. Cochran, Sampling Techniques, 3rd edition, 1977,
    sections 9A and 11): squared sums of residuals of the clusters against their stratum's share,
    and the variance of how many runs fall into each stratum.
    """
    total = len(hits)
    share = sum(hits) / total if total else 0.0
    if not 0.0 < share < 1.0:
        return 1.0
    strata: dict[Hashable, dict[Hashable, list[bool]]] = {}
    for number, (hit, window) in enumerate(zip(hits, windows, strict=True)):
        stratum, cluster = window or (None, number)
        strata.setdefault(stratum, {}).setdefault(cluster, []).append(hit)
    variance = 0.0
    for clusters in strata.values():
        size = sum(map(len, clusters.values()))
        own = sum(map(sum, clusters.values())) / size
        variance += size * (own - share) ** 2
        squares = sum((sum(each) - own * len(each)) ** 2 for each in clusters.values())
        variance += squares * len(clusters) / max(1, len(clusters) - 1)
    return max(1.0, variance / (total * share * (1.0 - share)))


def shares_to_json(found: Mapping[Outcome, Share]) -> dict[str, dict[str, Any]]:
    """What `shares` says, as plain values; a share of nothing is null."""
    return {
        outcome.value: {
            "count": share.count,
            "of": share.total,
            "share": None if math.isnan(share.share) else share.share,
            "wilson95": [share.low, share.high],
        }
        for outcome, share in found.items()
    }


def signal_name(number: int) -> str:
    """What a signal is called."""
    known = {each.value for each in signal.Signals}
    return signal.Signals(number).name if number in known else f"signal {number}"


def counted(names: Iterable[str]) -> dict[str, int]:
    """How often each name occurs, the most frequent first."""
    counts = Counter(names)
    return {name: counts[name] for name in sorted(counts, key=lambda n: (-counts[n], n))}
