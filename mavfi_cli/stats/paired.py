"""Two treatments of the same missions: McNemar's test, sign flips, and Holm's correction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
_EXACT = 16  # differences up to which all signs are tried
_FLIPS = 9999  # random ones for more
_CHUNK = 4_000_000  # numbers that are drawn at once
_SLACK = 1e-9  # of the largest sum: equal ones differ by rounding


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


def mcnemar(first: Sequence[bool] | BoolArray, second: Sequence[bool] | BoolArray) -> McNemar:
    """McNemar's test (Psychometrika 12, 1947), exact: the differing pairs as fair coins.

    Args:
        first, second: success of each treatment, (n,) a mission.
    """
    ends = 2 * np.asarray(first, dtype=np.int64) + np.asarray(second, dtype=np.int64)
    neither, only_second, only_first, both = np.bincount(ends, minlength=4).tolist()
    return McNemar(
        both=both,
        only_first=only_first,
        only_second=only_second,
        neither=neither,
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


def sign_flips(differences: Sequence[float], *, seed: int = 1) -> float:
    """Fisher's randomisation test of paired differences: two-sided probability of such a mean.

    Without an effect a difference is as likely to have the other sign. It needs no shape of the
    distribution, so it holds where most differences are zero and a bootstrap interval is too
    narrow (R. A. Fisher, The Design of Experiments, 1935, section 21). All signs are tried, of
    more than _EXACT differences _FLIPS random ones, seeded.

    Args:
        differences: one of each independent pair; zeros have no part in it.

    Returns:
        1 where nothing differs.
    """
    values = np.array([each for each in differences if each != 0.0])
    count = len(values)
    if count == 0:
        return 1.0
    least = abs(float(values.sum())) - _SLACK * float(np.abs(values).sum())
    if count <= _EXACT:
        flipped = (np.arange(1 << count)[:, None] >> np.arange(count)) & 1
        return float(np.mean(np.abs((1 - 2 * flipped) @ values) >= least))
    rng = np.random.Generator(np.random.PCG64(seed))
    rows = max(1, _CHUNK // count)
    extreme = 0
    for done in range(0, _FLIPS, rows):
        signs = 1 - 2 * rng.integers(2, size=(min(rows, _FLIPS - done), count))
        extreme += int(np.count_nonzero(np.abs(signs @ values) >= least))
    return (1 + extreme) / (1 + _FLIPS)


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
