"""Outcomes of isolated runs, and proportions with their confidence intervals."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A proportion with its Wilson score interval."""

    count: int
    total: int
    share: float
    low: float
    high: float


def wilson(count: int, total: int, *, confidence_z: float = 1.959963984540054) -> Share:
    """Wilson score interval (E. B. Wilson, JASA 22, 1927), 95 % by default.

    With no observation the interval is the whole of [0, 1] and the share is not a number.
    """
    if total == 0:
        return Share(count=0, total=0, share=math.nan, low=0.0, high=1.0)
    p = count / total
    z2 = confidence_z**2
    centre = (p + z2 / (2 * total)) / (1 + z2 / total)
    half = confidence_z * math.sqrt(p * (1 - p) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    return Share(
        count=count,
        total=total,
        share=p,
        low=max(0.0, centre - half) if count else 0.0,
        high=min(1.0, centre + half) if count < total else 1.0,
    )


def shares(outcomes: Iterable[Outcome]) -> dict[Outcome, Share]:
    """Each outcome's share of the *injected* runs; not injected ones are a share of all runs."""
    counts = dict.fromkeys(Outcome, 0)
    for outcome in outcomes:
        counts[outcome] += 1
    total = sum(counts.values())
    injected = total - counts[Outcome.NOT_INJECTED]
    return {
        outcome: wilson(count, total if outcome is Outcome.NOT_INJECTED else injected)
        for outcome, count in counts.items()
    }


def shares_to_json(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Any]]:
    """What `shares` says, as plain values; a share of nothing is null."""
    return {
        outcome.value: {
            "count": share.count,
            "of": share.total,
            "share": None if math.isnan(share.share) else share.share,
            "wilson95": [share.low, share.high],
        }
        for outcome, share in shares(outcomes).items()
    }


def counted(names: Iterable[str]) -> dict[str, int]:
    """How often each name occurs, the most frequent first."""
    counts = Counter(names)
    return {name: counts[name] for name in sorted(counts, key=lambda n: (-counts[n], n))}
