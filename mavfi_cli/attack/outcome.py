"""Outcomes of isolated runs, and their shares."""

from __future__ import annotations

import math
import signal
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from mavfi_cli.stats.clusters import Sampled, clustered_share
from mavfi_cli.stats.shares import Share


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Struck:
    """The sampled windows that runs hit, and how many windows of each stratum were sampled."""

    windows: Sequence[Window | None]  # None: the run's instruction is not from a sample
    sampled: Sampled


def shares(outcomes: Iterable[RunOutcome], struck: Struck | None = None) -> dict[RunOutcome, Share]:
    """Share of each outcome in the *injected* runs; not injected ones are a share of all runs.

    Args:
        outcomes: the outcome of each run.
        struck: if windows are a sample: the spread between them widens the intervals.
    """
    ended = list(outcomes)
    injected = [outcome is not RunOutcome.NOT_INJECTED for outcome in ended]
    everything = [True] * len(ended)
    found = {}
    for outcome in RunOutcome:
        of = everything if outcome is RunOutcome.NOT_INJECTED else injected
        found[outcome] = share_of([each is outcome for each in ended], of, struck)
    return found


def share_of(hits: Sequence[bool], of: Sequence[bool], struck: Struck | None = None) -> Share:
    """The share of hits in the runs `of` which it is, with its 95 % interval."""
    windows = [None] * len(hits) if struck is None else struck.windows
    runs = [(hit, window) for hit, counts, window in zip(hits, of, windows, strict=True) if counts]
    sampled = {} if struck is None else struck.sampled
    return clustered_share([hit for hit, _ in runs], [window for _, window in runs], sampled)


def shares_to_json(found: Mapping[RunOutcome, Share]) -> dict[str, dict[str, Any]]:
    """The result of `shares` as plain values."""
    return {outcome.value: share_to_json(share) for outcome, share in found.items()}


def share_to_json(share: Share) -> dict[str, Any]:
    """A share as plain values; a share of nothing is null."""
    return {
        "count": share.count,
        "of": share.total,
        "share": None if math.isnan(share.share) else share.share,
        "wilson95": [share.low, share.high],
    }


def signal_name(number: int) -> str:
    """The name of a signal."""
    known = {each.value for each in signal.Signals}
    return signal.Signals(number).name if number in known else f"signal {number}"


def counted(names: Iterable[str]) -> dict[str, int]:
    """Count each name, the most frequent first."""
    counts = Counter(names)
    return {name: counts[name] for name in sorted(counts, key=lambda n: (-counts[n], n))}
