"""The worst case of a setting and its recovery by protection, as in section VII-A of the paper.

The paper gives, for Factory, a worst-case flight time with faults 73.8 % above the golden run's,
recovered by 64.2 % in section VII-A and by 87.1 % in Fig. 14: 64.2 / 73.8 = 87.0 %. So the first is
in points of the golden run and the second is a share of the increase. Both are given here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


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
            setting. Without protected missions, the recovery is NaN.
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


def worst_over_own(faulty: Sequence[float], protected: Sequence[float] = ()) -> WorstCase:
    """The worst case relative to own golden flights, independent of the missions' lengths.

    Args:
        faulty, protected: of each successful flight, its value over that of the successful golden
            flight of the same mission.
    """
    return worst_case([1.0], faulty, protected)
