"""What a detector does with faults and without: numbers of pairs, each with its interval.

A fault that was not injected, or that nothing read, is counted apart and is in no other number.
Harmful faults are all flown with the detectors; harmless ones only of the `complete` missions.
Everything about what a fault *does* comes from the unprotected flight: in a protected one the
detector may withhold the value before anybody reads it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.campaign.evaluation.pairs import (
    LONGER,
    ErrorFree,
    FaultPair,
    Harm,
    lengthening,
)
from mavfi_cli.campaign.outcome import Injected
from mavfi_cli.core.types import FloatArray
from mavfi_cli.link.session import SessionSettings
from mavfi_cli.stats.bootstrap import Interval, interval, median
from mavfi_cli.stats.paired import McNemar, mcnemar
from mavfi_cli.stats.shares import Mixture, Share, mixture, rate
from mavfi_cli.stats.worst_case import worst_over_own

RESAMPLES = 999
TICKS_PER_S = SessionSettings().state_rate_hz  # one control tick a state message
_NOTHING_SEEN = -math.log(0.025)  # upper 95 % limit of a Poisson count that was 0
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorFreeMetrics:
    """A detector on flights without faults, against the same flights without it.

    Attributes:
        hours: of flight with the detector, from taking over to the end of the mission.
        alarms, episodes: all alarms, and with those in a row as one.
        alarms_per_hour: bootstrap over flights; with no alarm at all, a Poisson upper limit.
        with_alarm: flights with at least one.
        lost: golden successes that failed with the detector; gained: the other way round.
        success: McNemar's test of the golden flights (first) against those with the detector.
        lengthening: median of flight time over golden flight time, minus 1, of both successful.
    """

    flights: int
    hours: float
    alarms: int
    episodes: int
    alarms_per_hour: Interval
    with_alarm: Share
    lost: Share
    gained: int
    success: McNemar
    lengthening: Interval


def error_free_metrics(pairs: Sequence[ErrorFree]) -> ErrorFreeMetrics:
    """Metrics of one detector on these flights."""
    alarms = np.array([pair.watched.alarm_count for pair in pairs], np.float64)
    hours = np.array([(pair.watched.flight_time_s or 0.0) / 3600.0 for pair in pairs])
    longer = [lengthening(pair.golden, pair.watched) for pair in pairs]
    test = mcnemar((pair.golden.succeeded, pair.watched.succeeded) for pair in pairs)
    return ErrorFreeMetrics(
        flights=len(pairs),
        hours=math.fsum(hours.tolist()),
        alarms=int(alarms.sum()),
        episodes=sum(pair.watched.episodes for pair in pairs),
        alarms_per_hour=_rate_per_hour(alarms, hours),
        with_alarm=rate(int(np.count_nonzero(alarms)), len(pairs)),
        lost=rate(test.only_first, test.both + test.only_first),
        gained=test.only_second,
        success=test,
        lengthening=_interval([each for each in longer if each is not None], median),
    )


def _rate_per_hour(alarms: FloatArray, hours: FloatArray) -> Interval:
    total = float(hours.sum())
    if total > 0.0 and not alarms.any():
        return Interval(value=0.0, low=0.0, high=_NOTHING_SEEN / total, count=len(alarms))
    return _over_missions(
        len(alarms), lambda rows: alarms[rows].sum(axis=-1) / hours[rows].sum(axis=-1)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class WorstFlight:
    """The worst successful flight time and its recovery, as in the paper's section VII-A.

    The paper flies one world with one seed. Here every mission has a seed of its own, so every
    flight is held against its own golden pair.

    Attributes:
        faulty, protected: the largest flight time over golden flight time, minus 1.
        recovered: how much lower the second is, in parts of the golden flight time. Resampled
            missions never hold a worse case than the worst that was seen, so the interval says
            how much it hangs on single flights, not how bad it can become.
        recovered_share: of the increase; not a number where no flight was LONGER.
    """

    faulty: float
    protected: float
    recovered: Interval
    recovered_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultMetrics:
    """A detector against faults.

    Attributes:
        planned: faults; of them not_injected, not_activated (nothing read what was struck) and
            active. All that follows is about the active ones, where nothing else is said.
        crashed: faults that killed a node: those are seen without any detector.
        harmful: LOST, LONGER or OTHERWISE; their numbers follow.
        flown: with this detector: all harmful faults, and the harmless ones of complete missions.
        not_struck: of them those that never struck, because the protected flight had parted from
            the other; in no rate of detection.
        detected_harmful: with an alarm at or after the strike.
        detected_active: the same of all faults of complete missions.
        detected_inactive: the same of faults that were struck but not activated.
        by_chance: flights of complete missions that have an alarm in that time without their
            fault as well.
        latency_s, latency_ticks: median and 95th percentile from strike to alarm, harmful faults.
        recovered: of the lost missions those that succeed with protection.
        undone: of the harmful faults those that do no harm with protection.
        added: of the harmless faults those that do harm with protection.
        golden, unprotected: success rates of all missions with an active fault.
        protected: the same with the detector: harmful and harmless faults, each with its own
            rate, weighted by how many there are.
        success: McNemar's test on complete missions, unprotected first.
        worst: flight time, of the faults that were flown with this detector.
    """

    planned: int
    not_injected: int
    not_activated: int
    active: int
    crashed: int
    harmful: Share
    lost: int
    longer: int
    otherwise: int
    flown: int
    not_struck: int
    detected_harmful: Share
    detected_active: Share
    detected_inactive: Share
    by_chance: Share
    latency_s: Interval
    latency_s_p95: Interval
    latency_ticks: float
    latency_ticks_p95: float
    recovered: Share
    undone: Share
    added: Share
    golden: Share
    unprotected: Share
    protected: Mixture
    success: McNemar
    worst: WorstFlight


def fault_metrics(bare: Sequence[FaultPair], pairs: Sequence[FaultPair]) -> FaultMetrics:
    """Metrics of one detector on these faults.

    Args:
        bare: the faults without a detector, all of them.
        pairs: those that were flown with the detector.
    """
    injected = [pair for pair in bare if pair.faulty.injected is not Injected.NOT_INJECTED]
    active = [pair for pair in injected if pair.active]
    harms = Counter(pair.harm for pair in active)
    flown = [pair for pair in pairs if pair.active]
    harmful = [pair for pair in flown if pair.harm is not Harm.NONE]
    harmless = [pair for pair in flown if pair.harm is Harm.NONE and pair.complete]
    complete = [pair for pair in flown if pair.complete]
    lost = [pair for pair in harmful if pair.harm is Harm.LOST]
    latencies = [s for pair in harmful if (s := pair.latency_s) is not None]
    middle, late = _interval(latencies, median), _interval(latencies, _p95)
    return FaultMetrics(
        planned=len(bare),
        not_injected=len(bare) - len(injected),
        not_activated=len(injected) - len(active),
        active=len(active),
        crashed=sum(pair.faulty.crashed for pair in active),
        harmful=rate(len(active) - harms[Harm.NONE], len(active)),
        lost=harms[Harm.LOST],
        longer=harms[Harm.LONGER],
        otherwise=harms[Harm.OTHERWISE],
        flown=len(flown),
        not_struck=sum(not pair.struck for pair in flown),
        detected_harmful=_detected(harmful),
        detected_active=_detected(complete),
        detected_inactive=_detected([pair for pair in pairs if not pair.active and pair.complete]),
        by_chance=_share([pair.by_chance for pair in complete if pair.struck]),
        latency_s=middle,
        latency_s_p95=late,
        latency_ticks=middle.value * TICKS_PER_S,
        latency_ticks_p95=late.value * TICKS_PER_S,
        recovered=_share([pair.protected.succeeded for pair in lost]),
        undone=_share([pair.remaining_harm is Harm.NONE for pair in harmful]),
        added=_share([pair.remaining_harm is not Harm.NONE for pair in harmless]),
        golden=_share([pair.golden.succeeded for pair in active]),
        unprotected=_share([pair.faulty.succeeded for pair in active]),
        protected=mixture(
            [
                (
                    len(active) - harms[Harm.NONE],
                    _share([pair.protected.succeeded for pair in harmful]),
                ),
                (harms[Harm.NONE], _share([pair.protected.succeeded for pair in harmless])),
            ]
        ),
        success=mcnemar((pair.faulty.succeeded, pair.protected.succeeded) for pair in complete),
        worst=_worst(flown),
    )


def recoveries_compared(
    first: Sequence[FaultPair], second: Sequence[FaultPair]
) -> tuple[McNemar, McNemar]:
    """Two detectors on the same harmful faults: lost missions recovered, and harm undone."""

    def key(pair: FaultPair) -> tuple[object, ...]:
        """What two detectors' pairs of the same fault have in common."""
        return pair.world, pair.seed, pair.level, pair.stage, pair.target, pair.field

    other = {key(pair): pair for pair in second}
    both = [(pair, other[key(pair)]) for pair in first if pair.active and key(pair) in other]
    lost = [(a, b) for a, b in both if a.harm is Harm.LOST]
    harmful = [(a, b) for a, b in both if a.harm is not Harm.NONE]
    return (
        mcnemar((a.protected.succeeded, b.protected.succeeded) for a, b in lost),
        mcnemar((a.remaining_harm is Harm.NONE, b.remaining_harm is Harm.NONE) for a, b in harmful),
    )


def _detected(pairs: Sequence[FaultPair]) -> Share:
    return _share([pair.alarm is not None for pair in pairs if pair.struck])


def _share(told: Sequence[bool]) -> Share:
    return rate(sum(told), len(told))


def _worst(pairs: Sequence[FaultPair]) -> WorstFlight:
    faulty = _increases([lengthening(pair.golden, pair.faulty) for pair in pairs])
    protected = _increases([lengthening(pair.golden, pair.protected) for pair in pairs])
    if not (np.isfinite(faulty).any() and np.isfinite(protected).any()):
        return WorstFlight(
            faulty=math.nan,
            protected=math.nan,
            recovered=Interval(value=math.nan, low=math.nan, high=math.nan, count=0),
            recovered_share=math.nan,
        )
    usable = np.isfinite(faulty) | np.isfinite(protected)
    faulty, protected = faulty[usable], protected[usable]

    def recovered(rows: IntArray) -> FloatArray:
        """What protection takes off the worst increase (k,), for resamples of missions (k, n)."""
        # A sample without any successful flight of a kind has no worst one: as if none was longer.
        worst = [np.maximum(each[rows].max(axis=-1), 0.0) for each in (faulty, protected)]
        return np.asarray(worst[0] - worst[1])

    worst = worst_over_own((1.0 + faulty).tolist(), (1.0 + protected).tolist())
    return WorstFlight(
        faulty=worst.increase,
        protected=worst.protected_worst - 1.0,
        recovered=_over_missions(len(faulty), recovered),
        recovered_share=worst.recovered_share if worst.increase > LONGER else math.nan,
    )


def _increases(values: Sequence[float | None]) -> FloatArray:
    """Flight time increases (n,), minus infinity for flights that failed."""
    return np.array([-math.inf if each is None else each for each in values])


def _p95(values: FloatArray) -> FloatArray:
    return np.asarray(np.quantile(values, 0.95, axis=-1))


def _interval(values: Sequence[float], statistic: Callable[[FloatArray], FloatArray]) -> Interval:
    return interval(values, statistic, resamples=RESAMPLES)


def _over_missions(count: int, statistic: Callable[[IntArray], FloatArray]) -> Interval:
    """A statistic of several columns, by resampling their rows together.

    Args:
        statistic: of rows (..., n) of the columns, over the last axis.
    """
    return interval(
        np.arange(count, dtype=np.float64),
        lambda rows: statistic(rows.astype(np.int64)),
        resamples=RESAMPLES,
    )
