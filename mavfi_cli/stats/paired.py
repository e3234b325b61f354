"""Two treatments of the same missions: McNemar's test, sign flips, Holm's correction, worst case.

The worst case and its recovery are those of the paper's section VII-A. It gives, for Factory, a
worst-case flight time with faults 73.8 % above the golden run's, recovered by 64.2 % in section
VII-A and by 87.1 % in Fig. 14: 64.2 / 73.8 = 87.0 %. So the first is in points of the golden run
and the second is a share of the increase. Both are given here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
_EXACT = 16  # all signs are tried up to this many differences
_FLIPS = 9999  # number of random sign patterns for more
_CHUNK = 4_000_000  # numbers drawn at once
OWN = (1.0,)  # golden values over their own, for `worst_case` whatever the missions' lengths
_SLACK = 1e-9  # relative to the largest sum; equal sums differ by rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class McNemar:
    """Counts of pairs by success, and the p-value of the difference.

    Attributes:
        both, neither: pairs in which both or neither succeeded.
        only_first, only_second: pairs in which only one succeeded.
        p_value: two-sided, exact.
    """

    both: int
    only_first: int
    only_second: int
    neither: int
    p_value: float

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def difference(self) -> float:
        """Success rate of the second minus that of the first; NaN without pairs."""
        return (self.only_second - self.only_first) / self.pairs if self.pairs else math.nan


def mcnemar(first: Sequence[bool] | BoolArray, second: Sequence[bool] | BoolArray) -> McNemar:
    """McNemar's test (Psychometrika 12, 1947), exact: the differing pairs as fair coins.

    Args:
        first, second: success of each mission under each treatment, (n,).
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


def sign_flips(differences: Sequence[float]) -> float:
    """Two-sided p-value of Fisher's randomisation test of paired differences.

    Without an effect both signs of a difference are equally likely. The test assumes no
    distribution, so it is valid if most differences are zero and a bootstrap interval is too
    narrow (R. A. Fisher, The Design of Experiments, 1935, section 21). All signs are tried. For
    more than _EXACT differences, _FLIPS seeded random patterns are tried.

    Args:
        differences: one for each independent pair; zeros have no effect.

    Returns:
        1 if nothing differs.
    """
    values = np.array([each for each in differences if each != 0.0])
    count = len(values)
    if count == 0:
        return 1.0
    least = abs(float(values.sum())) - _SLACK * float(np.abs(values).sum())
    if count <= _EXACT:
        flipped = (np.arange(1 << count)[:, None] >> np.arange(count)) & 1
        return float(np.mean(np.abs((1 - 2 * flipped) @ values) >= least))
    rng = np.random.Generator(np.random.PCG64(1))
    rows = max(1, _CHUNK // count)
    extreme = 0
    for done in range(0, _FLIPS, rows):
        signs = 1 - 2 * rng.integers(2, size=(min(rows, _FLIPS - done), count))
        extreme += int(np.count_nonzero(np.abs(signs @ values) >= least))
    return (1 + extreme) / (1 + _FLIPS)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected for a family of tests (S. Holm, Scand. J. Statistics 6, 1979).

    The order is kept. Reject if the corrected value is below the level.
    """
    count = len(p_values)
    corrected = [0.0] * count
    highest = 0.0
    for rank, index in enumerate(sorted(range(count), key=lambda i: p_values[i])):
        highest = max(highest, min(1.0, (count - rank) * p_values[index]))
        corrected[index] = highest
    return corrected


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstCase:
    """Worst values of successful flights, compared with the golden ones.

    Attributes:
        golden: the reference, the mean of the golden flights.
        golden_worst, faulty_worst, protected_worst: the largest values.
        increase: faulty worst case over the reference, minus 1; 0.738 in the example.
        recovered: reduction by protection, in the same unit; 0.642.
        recovered_share: recovered part of the increase, 0.87; NaN unless the faulty worst case
            exceeds the worst golden one.
    """

    golden: float
    golden_worst: float
    faulty_worst: float
    protected_worst: float
    increase: float
    recovered: float
    recovered_share: float


def worst_case(
    golden: Sequence[float], faulty: Sequence[float], protected: Sequence[float] = ()
) -> WorstCase:
    """The worst case and its recovery.

    Args:
        golden, faulty, protected: flight times, or energies, of the successful missions of each
            setting. Without protected missions, the recovery is NaN. Where each value is over that
            of the same mission's golden flight, `golden` is OWN.
    """
    if not golden or not faulty:
        nan = math.nan
        return WorstCase(
            golden=nan, golden_worst=nan, faulty_worst=nan, protected_worst=nan, increase=nan,
            recovered=nan, recovered_share=nan,
        )  # fmt: skip
    reference = math.fsum(golden) / len(golden)
    worst = max(protected) if protected else math.nan
    increase = max(faulty) / reference - 1.0
    recovered = (max(faulty) - worst) / reference
    beyond = max(faulty) > max(golden)
    return WorstCase(
        golden=reference,
        golden_worst=max(golden),
        faulty_worst=max(faulty),
        protected_worst=worst,
        increase=increase,
        recovered=recovered,
        recovered_share=recovered / increase if beyond else math.nan,
    )
