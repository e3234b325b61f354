"""Flights of one mission side by side: golden, with a fault, and with a fault and a detector."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.evaluation.plan import ERROR_FREE, NONE
from mavfi_cli.campaign.missions import Label
from mavfi_cli.campaign.outcome import Injected, MissionResult
from mavfi_cli.core.types import Outcome

LONGER = 0.05  # of the golden flight time: from here on a fault has done harm
Key = tuple[Label, ...]  # world, seed, level, stage, target, field
_KEY = ("world", "seed", "level", "stage", "target", "field")


class Harm(Enum):
    """What a fault did to an unprotected flight, against its golden pair."""

    NONE = "none"
    LOST = "lost"  # the golden flight reached the goal, this one did not
    LONGER = "longer"  # both did, this one took more than LONGER longer
    OTHERWISE = "otherwise"  # both failed, in different ways


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """One alarm of a flight."""

    stamp_s: float
    stage: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What came of one mission, as far as an evaluation looks at it.

    Attributes:
        flight_time_s: None where the mission ended before its record.
        injected: what became of its fault.
        struck_s: simulated time of the first strike; None without one.
        states: that were struck; of an instruction, the node.
        bits: that were flipped at the first strike.
        crashed: whether a node of the companion died.
        alarms: those that are listed in the record, oldest first.
        alarm_count: all of them.
        episodes: alarms in a row, one recovery each, count once.
        path: of the run folder; None where it was not kept.
    """

    outcome: str
    flight_time_s: float | None
    injected: Injected = Injected.GOLDEN
    struck_s: float | None = None
    states: tuple[str, ...] = ()
    bits: tuple[int, ...] = ()
    crashed: bool = False
    alarms: tuple[Alarm, ...] = ()
    alarm_count: int = 0
    episodes: int = 0
    path: Path | None = None

    @property
    def succeeded(self) -> bool:
        """Whether it reached the goal."""
        return self.outcome == Outcome.SUCCESS.value

    def first_alarm(self, from_s: float) -> Alarm | None:
        """The first alarm at that time or later; None where none is listed."""
        return next((alarm for alarm in self.alarms if alarm.stamp_s >= from_s - 1e-9), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorFree:
    """A golden flight, and the same with a detector."""

    world: str
    seed: int
    detector: str
    golden: Flown
    watched: Flown


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultPair:
    """A golden flight, the same with a fault, and with a detector besides.

    Attributes:
        field: sign, exponent, mantissa, integer, or any.
        watched: golden flight with the detector: what it does without any fault.
        protected: the faulty flight itself for the detector `none`.
        complete: of its mission all faults are flown with detectors; otherwise this one is,
            because it is harmful.
    """

    world: str
    seed: int
    level: str
    stage: str
    target: str
    field: str
    detector: str
    golden: Flown
    faulty: Flown
    watched: Flown
    protected: Flown
    complete: bool = True

    @property
    def state(self) -> str:
        """What was to be struck: a state, or the attacked node."""
        return "+".join(self.faulty.states) or self.target

    @property
    def active(self) -> bool:
        """The unprotected flight was struck, and something read it or may have."""
        return self.faulty.injected in (Injected.ACTIVE, Injected.UNREAD)

    @property
    def harm(self) -> Harm:
        """What the fault did without protection."""
        return harm_of(self.golden, self.faulty)

    @property
    def remaining_harm(self) -> Harm:
        """What it did with protection."""
        return harm_of(self.golden, self.protected)

    @property
    def struck(self) -> bool:
        """Whether the protected flight was struck: otherwise there was nothing to detect."""
        return self.protected.struck_s is not None

    @property
    def alarm(self) -> Alarm | None:
        """The protected flight's first alarm at or after the strike."""
        if self.protected.struck_s is None:
            return None
        return self.protected.first_alarm(self.protected.struck_s)

    @property
    def by_chance(self) -> bool:
        """Whether the detector raises an alarm from then on without the fault, too."""
        struck_s = self.protected.struck_s
        return struck_s is not None and self.watched.first_alarm(struck_s) is not None

    @property
    def latency_s(self) -> float | None:
        """From the strike to that alarm, simulated seconds."""
        alarm, struck_s = self.alarm, self.protected.struck_s
        return None if alarm is None or struck_s is None else max(0.0, alarm.stamp_s - struck_s)


def harm_of(golden: Flown, flown: Flown) -> Harm:
    """What a treatment did to a mission, against its golden flight.

    A mission that failed and now succeeds has suffered no harm.
    """
    if flown.succeeded:
        longer = golden.succeeded and (lengthening(golden, flown) or 0.0) > LONGER
        return Harm.LONGER if longer else Harm.NONE
    if golden.succeeded:
        return Harm.LOST
    return Harm.NONE if flown.outcome == golden.outcome else Harm.OTHERWISE


def lengthening(golden: Flown, flown: Flown) -> float | None:
    """By what part of the golden flight time another flight was longer; None if either failed."""
    if not (golden.succeeded and flown.succeeded):
        return None
    if not golden.flight_time_s or flown.flight_time_s is None:
        return None
    return flown.flight_time_s / golden.flight_time_s - 1.0


def flown_of(entry: MissionResult) -> Flown:
    """What a row of the ledger says."""
    result = entry.result
    detection: Mapping[str, Any] = result.get("detection") or {}
    fault: Mapping[str, Any] = result.get("fault") or {}
    struck_s, states, bits = _struck(fault)
    quality = result.get("quality_of_flight") or {}
    assert entry.outcome is not None
    return Flown(
        outcome=entry.outcome,
        flight_time_s=quality.get("flight_time_s"),
        injected=entry.injected or Injected.GOLDEN,
        struck_s=struck_s,
        states=states,
        bits=bits,
        crashed=any(node["crashes"] for node in (result.get("nodes") or {}).values()),
        alarms=tuple(
            Alarm(stamp_s=alarm["stamp_s"], stage=alarm["stage"])
            for alarm in detection.get("alarms", ())
        ),
        alarm_count=detection.get("alarm_count", 0),
        episodes=sum(each["count"] for each in detection.get("recoveries", {}).values()),
        path=entry.path,
    )


def _struck(fault: Mapping[str, Any]) -> tuple[float | None, tuple[str, ...], tuple[int, ...]]:
    """When the fault struck first, and what, from its record."""
    applied = fault.get("state") == "applied"
    if fault.get("level") == "source":
        strikes = fault.get("strikes") or []
        bits = tuple(strikes[0]["changes"][0]["bits"]) if strikes else ()
        struck_s = strikes[0]["stamp_s"] if applied and strikes else None
        return struck_s, tuple(fault.get("states", ())), bits
    if not fault:
        return None, (), ()
    corruption = fault.get("corruption") or {}
    struck_s = fault["stamp_s"] if applied else None
    return struck_s, (fault["node"],), tuple(corruption.get("bits", ()))


class Flights:
    """What has been flown, to be looked up by what it was."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str, Key], Flown] = {}

    def add(self, labels: Mapping[str, Label], flown: Flown) -> None:
        """One mission that was flown."""
        kind, detector = str(labels["kind"]), str(labels["detector"])
        self._found[kind, detector, _key_of(labels)] = flown

    def error_free(self, detectors: Iterable[str]) -> list[ErrorFree]:
        """Pairs without faults, in the order in which they were added."""
        wanted = set(detectors)
        pairs = []
        for (kind, detector, key), watched in self._found.items():
            golden = self._found.get((ERROR_FREE, NONE, key))
            if kind == ERROR_FREE and detector in wanted and golden is not None:
                pairs.append(
                    ErrorFree(
                        world=str(key[0]), seed=int(str(key[1])), detector=detector,
                        golden=golden, watched=watched,
                    )
                )  # fmt: skip
        return pairs

    def faults(self, detectors: Iterable[str], complete: Callable[[int], bool]) -> list[FaultPair]:
        """Pairs with a fault, of which all flights are there.

        Args:
            complete: whether all faults of the mission with this seed are flown with detectors.
        """
        wanted = set(detectors)
        pairs = []
        for (kind, detector, key), protected in self._found.items():
            if kind == ERROR_FREE or detector not in wanted:
                continue
            mission = (*key[:2], *[None] * (len(_KEY) - 2))
            golden = self._found.get((ERROR_FREE, NONE, mission))
            watched = self._found.get((ERROR_FREE, detector, mission))
            faulty = self._found.get((kind, NONE, key))
            if golden is None or watched is None or faulty is None:
                continue
            pairs.append(
                FaultPair(
                    world=str(key[0]), seed=int(str(key[1])), level=str(key[2]),
                    stage=str(key[3]), target=str(key[4]), field=str(key[5]), detector=detector,
                    golden=golden, faulty=faulty, watched=watched, protected=protected,
                    complete=complete(int(str(key[1]))),
                )
            )  # fmt: skip
        return pairs


def _key_of(labels: Mapping[str, Label]) -> Key:
    return tuple(labels.get(name) for name in _KEY)
