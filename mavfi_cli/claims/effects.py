"""Lost, longer and recovered missions as numbers with intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from mavfi_cli.claims.flights import EVERY_STAGE, LONGER, FlownMission, GoldenFlights, where
from mavfi_cli.report.tables.paper_table import count_of
from mavfi_cli.stats.bootstrap import Interval
from mavfi_cli.stats.effects import (
    as_interval,
    excess_over_mean,
    longest_reaches,
    paired_difference,
    rate_difference,
)
from mavfi_cli.stats.paired import McNemar, mcnemar
from mavfi_cli.stats.shares import Share, wilson


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What our missions say about a claim.

    Attributes:
        effect: None if no mission tells.
        told: the counts behind it.
    """

    effect: Interval | None
    told: str


NOTHING = Finding(effect=None, told="")


def struck(flights: Iterable[FlownMission], *, detector: str | None = None) -> list[FlownMission]:
    """The flights with a flipped bit, without a detector or with this one."""
    return where(flights, struck=True, detector=detector)


def lost_share(flights: Sequence[FlownMission]) -> Share:
    """The share of lost missions."""
    return wilson(sum(each.lost for each in flights), len(flights))


def harm_share(golden: GoldenFlights, flights: Iterable[FlownMission]) -> Share:
    """The share of missions that a fault loses or makes more than 5 % longer."""
    paired = golden.paired(flights)
    return wilson(sum(map(golden.harmed, paired)), len(paired))


def success_lost(golden: GoldenFlights, flights: Sequence[FlownMission]) -> Finding:
    """Success of the golden flights minus that of the same missions with a fault."""
    pairs = [(own, each) for each in flights if (own := golden.any_of(each)) is not None]
    if not pairs:
        return NOTHING
    test = mcnemar([not each.lost for each, _ in pairs], [not each.lost for _, each in pairs])
    change = paired_difference(test)
    return Finding(
        effect=_turned(change),
        told=f"{count_of(lost_share([each for _, each in pairs]))} lost; golden "
        f"{count_of(lost_share([each for each, _ in pairs]))}",
    )


def _turned(change: Interval) -> Interval:
    return Interval(value=-change.value, low=-change.high, high=-change.low, count=change.count)


def harm_difference(
    golden: GoldenFlights,
    first: Sequence[FlownMission],
    second: Sequence[FlownMission],
    names: tuple[str, str],
) -> Finding:
    """Share of harmful faults among the first minus that among the second."""
    shares = harm_share(golden, first), harm_share(golden, second)
    if not all(each.total for each in shares):
        return NOTHING
    told = "; ".join(f"{name} {count_of(each)}" for name, each in zip(names, shares, strict=True))
    return Finding(effect=rate_difference(*shares), told=f"harmful: {told}")


def harmful(golden: GoldenFlights, flights: Sequence[FlownMission]) -> Finding:
    """The share of harmful faults."""
    share = harm_share(golden, flights)
    if not share.total:
        return NOTHING
    return Finding(effect=as_interval(share), told=f"{count_of(share)} harmful")


def worst_as_long(
    golden: GoldenFlights, flights: Sequence[FlownMission], ratio: float, missions: int
) -> Finding:
    """The probability that the longest of so many flights reaches a ratio to its golden flight."""
    ratios = golden.ratios(flights)
    if not ratios:
        return NOTHING
    beyond = wilson(sum(each >= ratio for each in ratios), len(ratios))
    return Finding(
        effect=longest_reaches(beyond, missions),
        told=f"{count_of(beyond)} as long; longest {100.0 * (max(ratios) - 1.0):+.1f} %",
    )


# Protection: the same faults without and with a detector ------------------------------------------


@dataclass(frozen=True, slots=True)
class Protected:
    """Faults that were flown without and with a detector, and their golden flights."""

    golden: GoldenFlights
    pairs: Sequence[tuple[FlownMission, FlownMission]]  # without, with

    @classmethod
    def of(
        cls, flights: Sequence[FlownMission], detector: str, protect: str = EVERY_STAGE
    ) -> Protected:
        """The faults of these flights that a detector has seen.

        Args:
            protect: the protected stages.
        """
        golden = GoldenFlights(flights)
        bare = {(each.pair, each.fault): each for each in struck(flights)}
        pairs = [
            (own, each)
            for each in flights
            if each.detector == detector
            and each.protect == protect
            and (own := bare.get((each.pair, each.fault))) is not None
            and golden.of(own) is not None
        ]
        return cls(golden, pairs)

    def recovered(self) -> Finding:
        """The share of lost missions that the detector saves."""
        lost = [(own, each) for own, each in self.pairs if own.lost]
        share = wilson(sum(not each.lost for _, each in lost), len(lost))
        if not share.total:
            return self._none("lost")
        return Finding(effect=as_interval(share), told=f"{count_of(share)} lost missions saved")

    def _none(self, what: str) -> Finding:
        """What is told if none of the faults, flown without the detector, had an effect."""
        if not self.pairs:
            return NOTHING
        return Finding(effect=None, told=f"without it 0 of {len(self.pairs):,} {what}")

    def undone(self, *, longer_only: bool = False) -> Share:
        """The share of harmful faults that do no harm with the detector."""
        harmed = [
            (own, each)
            for own, each in self.pairs
            if self.golden.harmed(own) and not (longer_only and own.lost)
        ]
        return wilson(sum(not self.golden.harmed(each) for _, each in harmed), len(harmed))

    def shortened(self) -> Finding:
        """The share of longer flights that the detector brings back within 5 %."""
        share = self.undone(longer_only=True)
        if not share.total:
            return self._none("over 5 % longer")
        return Finding(
            effect=as_interval(share), told=f"{count_of(share)} longer flights brought back"
        )


def compared(first: Protected, second: Protected) -> McNemar:
    """Success with the first and with the second detector, of the faults that both have seen."""
    ones, others = (
        {(own.pair, own.fault): not each.lost for own, each in one.pairs} for one in (first, second)
    )
    both = sorted(ones.keys() & others.keys())
    return mcnemar([ones[key] for key in both], [others[key] for key in both])


# The worst case, paired and unpaired ----------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _WorstFlights:
    """The longest flights of a setting.

    Attributes:
        flights: successful ones whose golden flight succeeds.
        longer: share of them that take more than 5 % longer than their own golden flight.
        paired: the largest flight time over that of its own golden flight, minus 1.
        unpaired: the longest flight over the mean golden one, minus 1.
        golden: the longest golden flight over the mean golden one, minus 1.
    """

    flights: int
    longer: Share
    paired: float
    unpaired: float
    golden: float


def worst_flights(golden: GoldenFlights, flights: Sequence[FlownMission]) -> _WorstFlights:
    """The worst case of a setting, as the paper may have read it in either way."""
    ratios = golden.ratios(flights)
    used = [each for each in flights if golden.ratio(each) is not None]
    own = {each.pair: each for each in map(golden.of, used) if each is not None}
    reference, longest = excess_over_mean(
        [each.flight_time_s or math.nan for each in own.values()],
        [each.flight_time_s or math.nan for each in used],
    )
    return _WorstFlights(
        flights=len(ratios),
        longer=wilson(sum(each > LONGER for each in ratios), len(ratios)),
        paired=max(ratios) - 1.0 if ratios else math.nan,
        unpaired=longest,
        golden=reference,
    )
