"""Measures: functions that compute the number that decides a claim.

claims.toml refers to them by name. A measure takes flights, isolated kernels or both. One that
takes flights also takes column values that select some of them, and counts only faults that flipped
a bit. Missions with the same world and seed form a cluster, and the intervals of shares include the
design effect of these clusters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.analysis.flights import COSTS, known, numbers
from mavfi_cli.analysis.kernels import IsolatedKernel
from mavfi_cli.analysis.pairs import EVERY_STAGE, LONGER, Flights
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.core.files import read_parquet
from mavfi_cli.core.types import FloatArray
from mavfi_cli.mission.run_folder import TRACE
from mavfi_cli.paper.verdicts import Finding
from mavfi_cli.stats.bootstrap import TABLE_RESAMPLES, interval
from mavfi_cli.stats.paired import net_share, paired_difference
from mavfi_cli.stats.shares import Interval, Share

Where = Mapping[str, Any]  # values of columns; a tuple allows several
Kernels = Mapping[str, IsolatedKernel]  # by name
NOT_FLOWN = Finding(why="not flown")
_DRAWS = 20_000  # posterior draws for a rank correlation
_FEWEST = 5  # minimum of kernels for a rank correlation, and of harmed missions for a share
_DETECTORS = ("gad", "aad")


def _clustered(flights: Flights, column: str = "lost", *, value: bool = True) -> Share:
    return flights.share(column, value=value, clustered=True)


def _of_share(share: Share, what: str, why: str = NOT_FLOWN.why) -> Finding:
    if not share.total:
        return Finding(why=why)
    return Finding(effect=share.effect, counts=f"{share.counts} {what}")


def _difference(shares: Sequence[Share], counts: str) -> Finding:
    """Subtract the second of two shares from the first."""
    first, second = shares
    if not (first.total and second.total):
        return NOT_FLOWN
    return Finding(effect=first.minus(second), counts=counts)


def _harm_gap(groups: Mapping[str, Flights], what: str) -> Finding:
    """Return the share of harmed missions in the first of two groups minus that in the second."""
    shares = [_clustered(flights, "harmed") for flights in groups.values()]
    counts = "; ".join(
        f"{name} {share.counts}{_unread(flights)}"
        for (name, flights), share in zip(groups.items(), shares, strict=True)
    )
    return _difference(shares, f"{what}: {counts}")


def _unread(flights: Flights) -> str:
    """State how many faults expired before anything read them; empty if there are none."""
    known = flights.chosen(harmed=(True, False))
    unread = known["injected"].count(Injected.NOT_ACTIVATED.value)
    return f", {unread:,} of them never read" if unread else ""


def _mean(flights: Flights, values: Sequence[float], counts: str) -> Finding:
    """Average a value within each cluster of flights and then over clusters, ignoring NaN."""
    clusters: dict[tuple[str, int], list[float]] = {}
    for seed, value in zip(flights.seeds, values, strict=True):
        if not math.isnan(value):
            clusters.setdefault(seed, []).append(value)
    if not clusters:
        return NOT_FLOWN
    means = [math.fsum(those) / len(those) for those in clusters.values()]
    average = interval(means, resamples=TABLE_RESAMPLES)
    number = sum(map(len, clusters.values()))
    effect = Interval(value=average.value, low=average.low, high=average.high, count=number)
    return Finding(effect=effect, counts=counts)


# Flights without a fault --------------------------------------------------------------------------


def _golden_success(flights: Flights, **where: Any) -> Finding:
    """Return the success rate of the golden flights."""
    return _of_share(
        _clustered(flights.golden.chosen(**where), value=False), "golden flights succeed"
    )


def _delta_range(flights: Flights, state: str, why: str) -> Finding:
    """Return how much narrower the range of a state's changes is than the range of its values.

    This is 1 - (range of the changes between ticks / range of the values), averaged over the
    successful golden flights.

    Args:
        state: column of the trace.
        why: the reason to give if no run folder was kept.
    """
    won = flights.golden.chosen(lost=False)
    reduced = []
    for run in won["path"]:
        trace = Path(run or "") / TRACE
        if run and trace.is_file():
            values = known(numbers(read_parquet(trace, "trace"), state))
            reduced.append(1.0 - float(np.ptp(np.diff(values))) / float(np.ptp(values)))
        else:
            reduced.append(math.nan)
    finding = _mean(won, reduced, "golden flights")
    return Finding(why=why) if len(won) and finding.effect is None else finding


# Faults without a detector ------------------------------------------------------------------------


def _success_lost(flights: Flights, **where: Any) -> Finding:
    """Return the success rate of golden flights minus that of the same missions with a fault."""
    both = flights.struck(**where).chosen(own_lost=(True, False))
    if not len(both):
        return NOT_FLOWN
    counts = f"{both.share().counts} lost; golden {both.share('own_lost').counts}"
    own, lost = both.flags("own_lost"), both.flags("lost")
    return Finding(effect=paired_difference(~lost, ~own, both.seeds), counts=counts)


def _most_lost_kernel(flights: Flights, **where: Any) -> Finding:
    """Return the success lost to faults in the kernel with the largest share of lost missions."""
    hit = flights.struck(**where).by("struck_kernel")
    kernels = {name: those.share().share for (name,), those in hit.items() if name}
    if not kernels:
        return NOT_FLOWN
    most = max(kernels, key=lambda name: kernels[name])
    finding = _success_lost(flights, **where, struck_kernel=most)
    counts = f"most in {most}: {finding.counts}"
    return Finding(effect=finding.effect, counts=counts, why=finding.why)


def _harm_difference(flights: Flights, groups: Mapping[str, Where]) -> Finding:
    """Return the share of harmful faults in the first of two groups minus that in the second."""
    return _harm_gap({name: flights.struck(**x) for name, x in groups.items()}, "harmful")


def _harmful(flights: Flights, **where: Any) -> Finding:
    """Return the share of faults that harm their mission."""
    hit = flights.struck(**where)
    return _of_share(_clustered(hit, "harmed"), f"harmful{_unread(hit)}")


def _loss_difference(
    flights: Flights, first: Where, second: Where, counts: str, **where: Any
) -> Finding:
    """Return the share of lost missions with the first group of faults minus that with the second.

    Args:
        counts: a format string for the counts of both groups.
    """
    shares = [_clustered(flights.struck(**where, **chosen)) for chosen in (first, second)]
    return _difference(shares, f"lost: {counts.format(*(share.counts for share in shares))}")


def _longer(flights: Flights, **where: Any) -> Finding:
    """Return the share of successes that take over LONGER times as long as their golden flights."""
    timed = flights.struck(**where).timed.chosen(lost=False)
    ratios = timed.ratios
    if not len(ratios):
        return NOT_FLOWN
    share = _clustered(timed, "harmed")
    most = 100.0 * (ratios.max() - 1.0)
    return _of_share(share, f"over {100 * (LONGER - 1):.0f} % longer; longest {most:+.1f} %")


def _longer_difference(flights: Flights, groups: Mapping[str, Where]) -> Finding:
    """Return the share of long flights in the first of two groups minus that in the second.

    Only faulty flights that succeed like their golden flights count. A flight is long if it takes
    more than LONGER times as long as its golden flight.
    """
    timed = {name: flights.struck(**where).timed for name, where in groups.items()}
    return _harm_gap(timed, "over 10 % longer")


def _mean_change(flights: Flights, column: str, *, ratio: bool = True, **where: Any) -> Finding:
    """Return a column's mean change from the golden to the faulty flight, where both succeed.

    Args:
        ratio: whether the change is relative.
    """
    golden = dict(zip(flights.golden["pair"], flights.golden[column], strict=True))
    timed = flights.struck(**where).timed
    changes = []
    for pair, value in zip(timed["pair"], timed[column], strict=True):
        own = golden.get(pair)
        known = own is not None and value is not None and (own > 0.0 or not ratio)
        changes.append((value - own) / (own if ratio else 1.0) if known else math.nan)
    return _mean(timed, changes, f"{len(timed):,} flights that succeed with and without the fault")


def _single_flight(flights: Flights, why: str, **where: Any) -> Finding:
    """Report our longest flight but no effect, because a single flight decides no claim."""
    ratios = flights.struck(**where).ratios
    if not len(ratios):
        return NOT_FLOWN
    return Finding(counts=f"ours: {100 * (ratios.max() - 1):+.1f} % of {len(ratios):,}", why=why)


def _not_measured(_: Flights, why: str) -> Finding:
    """Report no effect, whatever was flown."""
    return Finding(why=why)


# The same faults without and with a detector ------------------------------------------------------


def _net(seen: Flights, column: str, what: str) -> Finding:
    """Return (harm undone - harm caused) / harm without the detector, on the same faults.

    Args:
        column: the kind of harm, `harmed` or `lost`.
        what: words for the missions with this harm.
    """
    seen = seen.where(value is not None for value in seen[f"bare_{column}"])
    seen = seen.where(value is not None for value in seen[column])
    if not len(seen):
        return NOT_FLOWN
    before, after = seen.flags(f"bare_{column}"), seen.flags(column)
    undone, caused = int((before & ~after).sum()), int((~before & after).sum())
    counts = f"of {before.sum():,} {what}, {undone:,} undone; {caused:,} newly caused"
    if before.sum() < _FEWEST:
        few = f"without the detector {before.sum():,} of {len(seen):,} are {what}"
        return Finding(counts=counts if caused else "", why=f"{few}, too few to estimate a share")
    return Finding(effect=net_share(before, after, seen.seeds), counts=counts)


def _recovered(flights: Flights, detector: str, **where: Any) -> Finding:
    """Return (missions saved - missions newly lost) / missions lost without the detector."""
    return _net(flights.protected(detector, **where), "lost", "lost")


def _shortened(flights: Flights, detector: str, **where: Any) -> Finding:
    """Return (long flights undone - long flights caused) / long flights without the detector."""
    seen = flights.protected(detector, **where).chosen(bare_lost=False, lost=False)
    return _net(seen, "harmed", f"over {100 * (LONGER - 1):.0f} % longer")


def _undone_difference(
    flights: Flights, detector: str, first: str, others: Sequence[str], **where: Any
) -> Finding:
    """Return the net share of harm undone if `first` is watched, minus the largest of `others`.

    Args:
        first, others: sets of stages that the detector watches, each joined by `+`.
    """
    findings = {
        name: _net(flights.protected(detector, name, **where), "harmed", "harmful")
        for name in (first, *others)
    }
    best = None
    for name in others:
        effect = findings[name].effect
        if effect is None or findings[first].effect is None:
            return Finding(
                counts=findings[name].counts, why=findings[name].why or findings[first].why
            )
        if best is None or effect.value > best.value:
            best = effect
    effect = findings[first].effect
    assert effect is not None
    assert best is not None
    counts = "; ".join(f"{name}: {finding.counts}" for name, finding in findings.items())
    return Finding(effect=effect.minus(best), counts=counts)


def _density_gap(flights: Flights, detector: str, dense: str, free: str, **where: Any) -> Finding:
    """Return the share of protected missions harmed in a dense world minus that in a free one."""
    worlds = {name: flights.protected(detector, world=name, **where) for name in (dense, free)}
    return _harm_gap(worlds, "harmed with the detector")


def _autoencoder_better(flights: Flights, **where: Any) -> Finding:
    """Return the success rate with AAD minus that with GAD, on the same faults."""
    seen = [flights.protected(name, **where) for name in _DETECTORS]
    gad, aad = (
        {
            fault: (seed, not lost)
            for fault, seed, lost in zip(x.faults, x.seeds, x.flags("lost"), strict=True)
        }
        for x in seen
    )
    both = sorted(gad.keys() & aad.keys())
    if not both:
        return NOT_FLOWN
    first, second = (np.array([those[key][1] for key in both]) for those in (gad, aad))
    counts = (
        f"{int((second & ~first).sum())} missions by AAD only, "
        f"{int((first & ~second).sum())} by GAD only, of {len(both):,}"
    )
    effect = paired_difference(first, second, [gad[key][0] for key in both])
    return Finding(effect=effect, counts=counts)


# Costs of detectors -------------------------------------------------------------------------------

_NO_COSTS = Finding(why="this export does not hold these times; a new one does")


def _overhead_of(
    flights: Flights, detector: str, parts: Collection[str] = COSTS, **where: Any
) -> Finding:
    """Return the mean share of the flight time that `parts` of detection and recovery take.

    Args:
        parts: columns of COSTS, whose sum is averaged.
    """
    seen, shares = _overheads(flights, detector, parts, where)
    return _costs(seen, shares, f"{len(seen):,} flights")


def _gaussian_dearer(flights: Flights, **where: Any) -> Finding:
    """Return the overhead of GAD minus that of AAD, on the same faults."""
    gad, aad = (_overheads(flights, name, COSTS, where) for name in _DETECTORS)
    other = dict(zip(aad[0].faults, aad[1], strict=True))
    more = [
        cost - other.get(fault, math.nan) for fault, cost in zip(gad[0].faults, gad[1], strict=True)
    ]
    return _costs(gad[0], more, "the same faults with either detector")


def _overheads(
    flights: Flights, detector: str, parts: Collection[str], where: Where
) -> tuple[Flights, FloatArray]:
    """Return the flights that ran the detector, and the share of time that `parts` took in each.

    The shares are an array of shape (n,), with NaN for a flight whose export lacks them.
    """
    seen = flights.struck(detector=detector, protect=EVERY_STAGE, **where)
    return seen, np.sum([seen.numbers(name) for name in parts], axis=0)


def _costs(seen: Flights, costs: Sequence[float] | FloatArray, counts: str) -> Finding:
    finding = _mean(seen, list(costs), counts)
    return _NO_COSTS if len(seen) and finding.effect is None else finding


# Isolated kernels ---------------------------------------------------------------------------------


def _outcome_beside(
    kernels: Kernels, kernel: str, outcome: str, extreme: str, others: Sequence[str] = ()
) -> Finding:
    """Return the share of an outcome in a kernel minus the largest or smallest in other kernels.

    Args:
        extreme: `most` for the largest share among the other kernels, `least` for the smallest.
        others: names of the other kernels; empty means all.
    """
    there = [name for name in others or kernels if name in kernels and name != kernel]
    if kernel not in kernels or not there:
        return NOT_FLOWN
    choose = max if extreme == "most" else min
    other = choose(there, key=lambda name: kernels[name].outcomes[outcome].share)
    shares = {name: kernels[name].outcomes[outcome] for name in (kernel, other)}
    counts = (f"{kernels[name].title} {100 * x.share:.1f} %" for name, x in shares.items())
    effect = shares[kernel].minus(shares[other])
    return Finding(effect=effect, counts=", ".join(counts))


def _least_benign(kernels: Kernels, but: str) -> Finding:
    """Return the lowest share of benign runs among all kernels except `but`."""
    shares = {name: kernels[name].outcomes["benign"] for name in kernels if name != but}
    if not shares:
        return NOT_FLOWN
    least = min(shares, key=lambda name: shares[name].share)
    return _of_share(shares[least], f"benign in {kernels[least].title}, the least")


def _benign(kernels: Kernels, kernel: str) -> Finding:
    """Return the share of benign runs of a kernel."""
    if kernel not in kernels:
        return NOT_FLOWN
    return _of_share(kernels[kernel].outcomes["benign"], "benign")


def _ranking(flights: Flights, kernels: Kernels, **where: Any) -> Finding:
    """Return the rank correlation of kernels' SDC rates in isolation with their harm in flight.

    The correlation is Spearman's. The kernels are fixed, not drawn, so the interval covers only the
    shares: each is drawn from its posterior distribution under Jeffreys' prior.
    """
    flown = {
        name: _clustered(those, "harmed")
        for (name,), those in flights.struck(**where).by("struck_kernel").items()
        if name in kernels
    }
    if len(flown) < _FEWEST:
        return NOT_FLOWN
    if len({share.share for share in flown.values()}) == 1:
        return Finding(why="in flight all kernels do the same harm")
    rng = np.random.default_rng(1)
    silent = {name: kernels[name].outcomes["sdc"] for name in flown}
    drawn = [
        np.stack([_posterior(share, rng) for share in those])
        for those in (silent.values(), flown.values())
    ]
    low, high = np.percentile(_spearman(*drawn), [2.5, 97.5])
    shares = (np.array([[share.share] for share in those.values()]) for those in (silent, flown))
    value = float(_spearman(*shares)[0])
    count = sum(share.total for share in flown.values())
    order = sorted(flown, key=lambda name: -flown[name].share)
    counts = f"harm in flight, most first: {', '.join(order)}"
    effect = Interval(value=value, low=float(low), high=float(high), count=count)
    return Finding(effect=effect, counts=counts)


def _posterior(share: Share, rng: np.random.Generator) -> FloatArray:
    return rng.beta(share.count + 0.5, share.total - share.count + 0.5, _DRAWS)


def _spearman(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return Spearman's correlation of each column of two arrays of shape (kernels, n).

    The result has shape (n,). Ties get mean ranks.
    """
    from scipy.stats import rankdata

    ranks = [rankdata(values, axis=0) for values in (first, second)]
    a, b = (values - values.mean(axis=0) for values in ranks)
    return np.asarray((a * b).sum(axis=0) / np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0)))


MEASURES: Mapping[str, Callable[..., Finding]] = {measure.__name__[1:]: measure for measure in (
    _golden_success, _delta_range, _success_lost, _most_lost_kernel, _harm_difference, _harmful,
    _loss_difference, _longer, _longer_difference, _mean_change, _single_flight, _not_measured,
    _recovered, _shortened, _undone_difference, _density_gap, _autoencoder_better, _overhead_of,
    _gaussian_dearer, _outcome_beside, _least_benign, _benign, _ranking,
)}  # fmt: skip
"""The measures by their names in claims.toml."""
OF_KERNELS = frozenset({"outcome_beside", "least_benign", "benign"})
"""The measures that take isolated kernels and no flights."""
WITHOUT_FATES = OF_KERNELS | {
    "golden_success", "delta_range", "single_flight", "not_measured", "overhead_of",
    "gaussian_dearer",
}  # fmt: skip
"""The measures that do not depend on what a fault does to its node."""
OF_GOLDEN = frozenset({"golden_success", "delta_range"})
"""The measures of flights without a fault, which depend on no rule."""
