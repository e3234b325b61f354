"""Outcomes of isolated runs, and their shares."""

from __future__ import annotations

import math
import signal
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from enum import Enum
from typing import Any

from mavfi_cli.stats.shares import Share, design_effect, wilson


class RunOutcome(Enum):
    """The outcome of one run of an isolated program or kernel."""

    BENIGN = "benign"
    CRASH = "crash"
    HANG = "hang"
    SDC = "sdc"
    NOT_INJECTED = "not_injected"

    @property
    def title(self) -> str:
        """The name in tables."""
        return "SDC" if self is RunOutcome.SDC else self.value.replace("_", " ")


Window = tuple[Hashable, int]  # stratum and number of the sampled window that a run hit


def shares(
    outcomes: Iterable[RunOutcome], windows: Iterable[Window | None] = ()
) -> dict[RunOutcome, Share]:
    """Share of each outcome in the *injected* runs; not injected ones are a share of all runs.

    Args:
        outcomes: the outcome of each run.
        windows: the window of each run if its instruction is from a sample of windows, else None.
            The similarity of runs in a window widens the intervals.
    """
    ended = list(outcomes)
    hit = list(windows) or [None] * len(ended)
    injected = [(o, w) for o, w in zip(ended, hit, strict=True) if o is not RunOutcome.NOT_INJECTED]
    found = {}
    for outcome in RunOutcome:
        of = list(zip(ended, hit, strict=True)) if outcome is RunOutcome.NOT_INJECTED else injected
        is_it = [each is outcome for each, _ in of]
        effect = design_effect(is_it, [window for _, window in of])
        found[outcome] = wilson(sum(is_it), len(of), design_effect=effect)
    return found


def shares_to_json(found: Mapping[RunOutcome, Share]) -> dict[str, dict[str, Any]]:
    """The result of `shares` as plain values; a share of nothing is null."""
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
    """The name of a signal."""
    known = {each.value for each in signal.Signals}
    return signal.Signals(number).name if number in known else f"signal {number}"


def counted(names: Iterable[str]) -> dict[str, int]:
    """Count each name, the most frequent first."""
    counts = Counter(names)
    return {name: counts[name] for name in sorted(counts, key=lambda n: (-counts[n], n))}
