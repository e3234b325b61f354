"""Two treatments of the same missions: McNemar's exact test, and Holm's correction of a family."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class McNemar:
    """The pairs of missions whose outcomes differ, and how likely that is by chance.

    Attributes:
        both, neither: pairs in which both, or none, succeeded.
        only_first, only_second: pairs in which one did.
        p_value: two-sided, exact.
    """

    both: int
    only_first: int
    only_second: int
    neither: int
    p_value: float

    @property
    def pairs(self) -> int:
        """How many pairs there are."""
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def difference(self) -> float:
        """Success rate of the second minus that of the first; not a number without pairs."""
        return (self.only_second - self.only_first) / self.pairs if self.pairs else math.nan


def mcnemar(pairs: Iterable[tuple[bool, bool]]) -> McNemar:
    """McNemar's test (Psychometrika 12, 1947), exact: the differing pairs as fair coins.

    Args:
        pairs: success of the first and of the second treatment, a pair a mission.
    """
    counts = {(True, True): 0, (True, False): 0, (False, True): 0, (False, False): 0}
    for first, second in pairs:
        counts[bool(first), bool(second)] += 1
    only_first, only_second = counts[True, False], counts[False, True]
    return McNemar(
        both=counts[True, True],
        only_first=only_first,
        only_second=only_second,
        neither=counts[False, False],
        p_value=_coins(min(only_first, only_second), only_first + only_second),
    )


def _coins(few: int, total: int) -> float:
    """Two-sided probability of at most `few` heads or tails among fair coins."""
    ways = tail = 1  # of no heads; whole numbers, exact up to the one division
    for heads in range(1, few + 1):
        ways = ways * (total - heads + 1) // heads
        tail += ways
    half: int = 1 << (total - 1) if total else 1
    return min(1.0, tail / half)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected for a family of tests (S. Holm, Scand. J. Statistics 6, 1979).

    In the order in which they came; reject where the corrected one is below the level.
    """
    count = len(p_values)
    corrected = [0.0] * count
    highest = 0.0
    for rank, index in enumerate(sorted(range(count), key=lambda i: p_values[i])):
        highest = max(highest, min(1.0, (count - rank) * p_values[index]))
        corrected[index] = highest
    return corrected
