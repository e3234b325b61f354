"""Stratified samples: how missions are allocated to strata, and rates from weighted missions.

A stratum is a part of the population, such as the flips of exponent bits. The weight of a mission
is the number of uniformly drawn missions that it stands for, so that the weights of a sample add up
to its size. The estimate of a total is the sum of weights times values (D. G. Horvitz and D. J.
Thompson, JASA 47, 1952). It is unbiased for any numbers of missions in the strata.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from mavfi_cli.stats.shares import (
    Share,
    StratifiedShare,
    missions_for_margin,
    score_interval,
    wilson,
    z_of,
)

DEFENCE = 0.25  # share of the missions that is allocated by size alone; bounds the weights by 4
_UNIT = 1 << 40  # integer that stands for 1 in `rounded`, so that sums are exact
_LEAST_MARGIN = 1e-6  # for narrower intervals no effective number is computed


def spread(hits: int, missions: int) -> float:
    """Return the standard deviation of one mission's outcome (hit 1, miss 0) in a stratum.

    Half a hit and half a miss are added, so the result is positive even without hits or missions.
    """
    share = (hits + 0.5) / (missions + 1.0)
    return math.sqrt(share * (1.0 - share))


def allocate(sizes: Sequence[float], spreads: Sequence[float], missions: int) -> list[int]:
    """Return how many missions to fly in each stratum, at least one in each.

    Each stratum gets one mission. Most of the other missions are allocated in proportion to size
    times spread (J. Neyman, J. Royal Statistical Society 97, 1934). A share DEFENCE of them is
    allocated in proportion to size alone, so that a stratum whose spread was underestimated still
    gets missions (T. Hesterberg, Technometrics 37, 1995).

    Args:
        sizes: shares of the strata in the population; they add up to 1.
        spreads: standard deviations in the strata, all above 0.
        missions: number of missions, at least the number of strata.
    """
    total = math.fsum(size * own for size, own in zip(sizes, spreads, strict=True))
    free = missions - len(sizes)
    wanted = [
        free * ((1.0 - DEFENCE) * size * own / total + DEFENCE * size)
        for size, own in zip(sizes, spreads, strict=True)
    ]
    counts = [math.floor(number) for number in wanted]
    by_rest = sorted(range(len(sizes)), key=lambda place: (counts[place] - wanted[place], place))
    for place in by_rest[: free - sum(counts)]:
        counts[place] += 1
    return [count + 1 for count in counts]


def rounded(table: Sequence[Sequence[float]], rng: np.random.Generator) -> list[list[int]]:
    """Round the cells of a table at random, so that no row or column sum changes by 1 or more.

    Each cell is rounded up or down, and its expected value stays the same (L. H. Cox, J. American
    Statistical Association 82, 1987). An additional row and column make all sums integers. While a
    cell is not an integer, the function finds a cycle of such cells that alternates between rows
    and columns. It raises and lowers them in turn by the same amount, so that at least one of them
    becomes an integer.

    Args:
        table: rows of equal length, with values of at least 0.
    """
    cells = [[round(value * _UNIT) for value in row] for row in table]
    cells = [[*row, -sum(row) % _UNIT] for row in cells]
    cells.append([-sum(column) % _UNIT for column in zip(*cells, strict=True)])
    for row in range(len(cells)):
        while any(value % _UNIT for value in cells[row]):
            cycle = _cycle(cells, row)
            even, odd = ([cells[r][c] for r, c in cycle[first::2]] for first in (0, 1))
            up, down = (
                min(*(-value % _UNIT for value in raised), *(value % _UNIT for value in lowered))
                for raised, lowered in ((even, odd), (odd, even))
            )
            change = up if rng.integers(up + down) < down else -down
            for place, (r, c) in enumerate(cycle):
                cells[r][c] += -change if place % 2 else change
    return [[value // _UNIT for value in row[:-1]] for row in cells[:-1]]


def _cycle(cells: Sequence[Sequence[int]], row: int) -> list[tuple[int, int]]:
    """Return the row and column indices of a cycle of non-integer cells.

    The cycle moves along rows and columns alternately. Every row or column that it visits contains
    two of its cells. The search starts in `row`, which must have a cell that is not an integer.
    """
    lines, path = [(0, row)], list[tuple[int, int]]()  # a line is a row (0) or a column (1)
    while True:
        axis, index = lines[-1]
        along = range(len(cells) if axis else len(cells[0]))
        places = ((other, index) if axis else (index, other) for other in along)
        cell = next(
            place for place in places
            if place not in path[-1:] and cells[place[0]][place[1]] % _UNIT
        )  # fmt: skip
        path.append(cell)
        line = (1 - axis, cell[1 - axis])
        if line in lines:
            return path[lines.index(line) :]
        lines.append(line)


def weighted_share(
    hits: Sequence[bool],
    counted: Sequence[bool],
    weights: Sequence[float],
    strata: Sequence[str | None],
    *,
    confidence: float = 0.95,
) -> Share:
    """Return the weighted share of hits among the counted missions of a stratified sample.

    The interval adds the distances to the ends of the strata's Wilson intervals in quadrature
    (MOVER; G. Y. Zou and A. Donner, Statistics in Medicine 27, 2008), so that a stratum without
    hits still has a width. The sample size of a stratum is the effective one, given by `kish`. The
    fraction of a stratum that is counted is also an estimate. Its error, times the difference
    between the stratum's share of hits and the overall share, is added in quadrature too.

    Args:
        hits, counted, weights, strata: (n,) one value for each flown mission. In a uniform sample
            the strata are None, and the interval is Wilson's.

    Returns:
        The share with its interval, the unweighted numbers of missions and hits, and the effective
        sample size.
    """
    number = sum(hit and kept for hit, kept in zip(hits, counted, strict=True))
    plain = wilson(number, sum(counted), confidence=confidence)
    total = math.fsum(weight for weight, kept in zip(weights, counted, strict=True) if kept)
    if not total or all(stratum is None for stratum in strata):
        return plain
    missions = [*zip(hits, counted, weights, strata, strict=True)]
    share = math.fsum(weight for hit, kept, weight, _ in missions if hit and kept) / total
    below, above = [], []
    for stratum in dict.fromkeys(strata):
        everyone = [mission for mission in missions if mission[3] == stratum]
        mine = [(hit, weight) for hit, kept, weight, _ in everyone if kept]
        whole, kept = (math.fsum(own[-1] for own in those) for those in (
            [(weight,) for *_, weight, _ in everyone], mine))  # fmt: skip
        if not mine:
            continue
        part = math.fsum(weight for hit, weight in mine if hit) / kept
        low, high = score_interval(part, kish([weight for _, weight in mine]), confidence)
        fraction = kept / whole
        spread_of_fraction = math.sqrt(
            fraction * (1.0 - fraction) / kish([weight for *_, weight, _ in everyone])
        )
        moved = z_of(confidence) * spread_of_fraction * whole * (part - share)
        below += [kept * (part - low), moved]
        above += [kept * (high - part), moved]
    low, high = share - math.hypot(*below) / total, share + math.hypot(*above) / total
    estimate = replace(plain, share=share, low=max(0.0, low), high=min(1.0, high))
    margin = (estimate.high - estimate.low) / 2.0
    if not _LEAST_MARGIN <= margin < 0.5:
        return estimate
    effective = missions_for_margin(margin, expected=share, confidence=confidence)
    return StratifiedShare(**asdict(estimate), effective=effective)


def kish(weights: Sequence[float]) -> float:
    """Return the effective sample size, (sum w)^2 / sum w^2 (L. Kish, Survey Sampling, 1965)."""
    return math.fsum(weights) ** 2 / math.fsum(weight**2 for weight in weights)
