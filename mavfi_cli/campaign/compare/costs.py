"""What faults cost on each platform, and the worst cases: the paper's Fig. 16.

The cost of a fault is the flight time over that of the golden flight of the same mission on the
same platform; both reached the goal. The paper flies one fixed world, so this is its measure where
worlds differ. The longest flight of all is given too, over the mean golden one: a part of it is the
mission's own length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mavfi_cli.campaign.compare.flights import Flown
from mavfi_cli.campaign.compare.plan import GOLDEN, NONE
from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.bootstrap import Interval, interval
from mavfi_cli.stats.paired import sign_flips
from mavfi_cli.stats.worst_case import worst_case, worst_over_own

LATE = 0.95  # the quantile beside the worst case, which has no interval
CONFIDENCE = 0.95
RESAMPLES = 1999
_SAME_S = 1e-6  # flight times that far apart are equal: a tick is 20 ms
Costs = Mapping[tuple[int, str], tuple[float, float]]  # of (seed, target): s, and ratio


@dataclass(frozen=True, slots=True, kw_only=True)
class Struck:
    """The counted flights of a platform and setting beside their own golden ones.

    Attributes:
        costs: of each pair that reached the goal, by mission: the difference, s, and the ratio.
        lost: flights that failed where the golden one reached the goal.
        longest_s: of all that reached the goal, whether or not the golden one did.
        worst: the one that is longest over its own golden one, the lowest seed of equal ones.
    """

    costs: Costs
    lost: int
    longest_s: float
    worst: Flown | None


def struck(golden: Sequence[Flown], counted: Sequence[Flown]) -> Struck:
    """Hold flights against the golden flights of the same missions.

    Args:
        golden: successful ones.
        counted: of one platform and setting.
    """
    own = {each.seed: each.flight_time_s for each in golden}
    known = [each for each in counted if each.seed in own]
    pairs = [each for each in known if each.succeeded]
    return Struck(
        costs={
            each.mission: (
                each.flight_time_s - own[each.seed],
                each.flight_time_s / own[each.seed],
            )
            for each in pairs
        },
        lost=len(known) - len(pairs),
        longest_s=max(_times([each for each in counted if each.succeeded]), default=math.nan),
        worst=max(
            pairs, key=lambda each: (each.flight_time_s / own[each.seed], -each.seed), default=None
        ),
    )


def cost_row(platform: str, setting: str, found: Struck, faults: Struck) -> dict[str, Any]:
    """What the faults of a setting cost on a platform.

    Args:
        faults: those without a detector on the same platform: what is recovered is theirs.

    Returns:
        `cost_s`: mean with its interval and the largest; `over_own`: the 95th percentile with its
        interval and the largest. Several faults of one mission are no independent samples:
        intervals draw missions. `recovered_share` is the part of the largest increase without
        detector that is gone, not a number where there is none.
    """
    table = _by_mission(found.costs)
    worst, bare = _largest(found, 1), _largest(faults, 1)
    protected = setting not in (GOLDEN, NONE)
    return {
        "platform": platform,
        "setting": setting,
        "pairs": len(found.costs),
        "lost": found.lost,
        "cost_s": {
            "mean": asdict(_over_missions(len(table), lambda drawn: _mean(table[drawn, :, 0]))),
            "largest": _largest(found, 0),
        },
        "over_own": {
            "p95": asdict(_over_missions(len(table), lambda drawn: _late(table[drawn, :, 1]))),
            "largest": worst,
            "recovered_share": worst_over_own([bare], [worst]).recovered_share
            if protected
            else math.nan,
        },
        "worst_flight": None
        if found.worst is None
        else {
            "seed": found.worst.seed,
            "target": found.worst.target,
            "fault_seed": found.worst.fault_seed,
        },
    }


def cost_difference(
    platform: str, reference: str, setting: str, first: Struck, second: Struck
) -> dict[str, Any]:
    """What the same faults cost on a platform beyond what they cost on the reference.

    Returns:
        `extra_s`: the mean difference of costs; `differ`: how many of them are not zero; `p_value`:
        of the mean, by missions; `p95_ratio`: of the 95th percentiles over own golden; all are
        over the faults that both platforms have a cost of. Of all flights of
        each platform: `largest_ratio` of the largest over own golden, `longest_ratio` of the
        longest in seconds.
    """
    shared = sorted(first.costs.keys() & second.costs.keys())
    here = _by_mission({mission: first.costs[mission] for mission in shared})
    there = _by_mission({mission: second.costs[mission] for mission in shared})
    extra = there[:, :, 0] - here[:, :, 0]
    extra[np.abs(extra) < _SAME_S] = 0.0
    return {
        "platform": platform,
        "reference": reference,
        "setting": setting,
        "pairs": len(shared),
        "differ": int(np.count_nonzero(np.nan_to_num(extra))),
        "extra_s": asdict(_over_missions(len(extra), lambda drawn: _mean(extra[drawn]))),
        "p_value": sign_flips(np.nansum(extra, axis=1).tolist()) if shared else math.nan,
        "p95_ratio": asdict(
            _over_missions(
                len(here), lambda drawn: _late(there[drawn, :, 1]) / _late(here[drawn, :, 1])
            )
        ),
        "largest_ratio": _largest(second, 1) / _largest(first, 1),
        "longest_ratio": second.longest_s / first.longest_s,
    }


def worst_row(
    platform: str,
    setting: str,
    golden: Sequence[Flown],
    faulty: Sequence[Flown],
    flights: Sequence[Flown],
) -> dict[str, Any]:
    """The longest successful flight of a setting, and over the mean golden one.

    Args:
        golden, faulty: of the platform, without a detector.
        flights: of the setting. What a detector recovers is not a number where the faults' longest
            flight is no longer than the longest golden one.
    """
    protected = setting not in (GOLDEN, NONE)
    found = worst_case(_times(golden), _times(flights))
    case = worst_case(_times(golden), _times(faulty), _times(flights) if protected else ())
    return {
        "platform": platform,
        "setting": setting,
        "flights": len(flights),
        "golden_mean_s": found.golden,
        "worst_s": found.faulty_worst,
        "over_mean_ratio": 1.0 + found.increase,
        "over_mean_recovered_share": case.recovered_share,
    }


def _times(flights: Sequence[Flown]) -> list[float]:
    return [each.flight_time_s for each in flights]


def _largest(found: Struck, measure: int) -> float:
    return max((cost[measure] for cost in found.costs.values()), default=math.nan)


# Missions as what is drawn ------------------------------------------------------------------------


def _by_mission(costs: Costs) -> FloatArray:
    """(missions, targets, 2) in the order of their seeds; not a number where there is no flight."""
    seeds = {seed: row for row, seed in enumerate(sorted({seed for seed, _ in costs}))}
    targets = {name: column for column, name in enumerate(sorted({name for _, name in costs}))}
    table = np.full((len(seeds), len(targets), 2), np.nan)
    for (seed, target), cost in costs.items():
        table[seeds[seed], targets[target]] = cost
    return table


def _over_missions(count: int, statistic: Callable[[Any], FloatArray]) -> Interval:
    """A statistic of missions with its interval; `statistic` takes (..., missions) indices."""
    return interval(
        np.arange(count, dtype=np.float64),
        lambda drawn: statistic(drawn.astype(np.intp)),
        confidence=CONFIDENCE,
        resamples=RESAMPLES,
    )


def _mean(values: FloatArray) -> FloatArray:
    """Over the last two axes, of what is there."""
    return np.asarray(np.nanmean(values, axis=(-2, -1)))


def _late(values: FloatArray) -> FloatArray:
    """The LATE quantile over the last two axes, of what is there.

    `numpy.nanquantile` with several axes goes row by row; sorting puts what is missing at the end.
    """
    flat = np.sort(values.reshape((*values.shape[:-2], -1)), axis=-1)
    place = LATE * (np.count_nonzero(~np.isnan(flat), axis=-1) - 1)
    low = np.floor(place).astype(np.intp)
    high = np.ceil(place).astype(np.intp)
    below = np.take_along_axis(flat, low[..., None], axis=-1)[..., 0]
    above = np.take_along_axis(flat, high[..., None], axis=-1)[..., 0]
    return np.asarray(below + (above - below) * (place - low))
