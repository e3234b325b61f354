"""Self-contained missions of a campaign, and their results."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from mavfi_cli.core.errors import ConfigError, MavfiError
from mavfi_cli.core.files import Json
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.spec.fault import is_omitted
from mavfi_cli.spec.mission import NOT_OF_GOLDEN, MissionConfig

Label = str | int | float | bool | None
Labels = Mapping[str, Label]  # of a setting, by name
Changes = Mapping[str, Any]  # values of a mission by name, as in JSON
_FIRST = ("setting", "world")  # labels that come before the others


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedMission:
    """One mission of a campaign. Its number is its zero-based position in the list.

    Attributes:
        labels: the mission's setting; missions with equal labels are counted together.
        pair: identifier of the mission's pair; missions with equal pairs share world, start and
            noise. An empty string is replaced by a hash of everything that the golden, faulty and
            protected flights of a pair share.
    """

    config: MissionConfig
    labels: Labels = field(default_factory=dict)
    pair: str = ""

    def __post_init__(self) -> None:
        if not self.pair:
            object.__setattr__(self, "pair", _pair_of(_shared(self.config)))

    @property
    def stored(self) -> tuple[str, str, str]:
        """The labels as JSON, the pair, and the changed fields as JSON, as a ledger stores them."""
        return canonical(dict(self.labels)), self.pair, canonical(changes_of(self.config))


_DEFAULT = MissionConfig()
_NAMES = tuple(field.name for field in fields(MissionConfig))
_SHARED = tuple(name for name in _NAMES if name not in NOT_OF_GOLDEN)
_shared = attrgetter(*_SHARED)


@functools.lru_cache(maxsize=4096)
def _pair_of(shared: tuple[Any, ...]) -> str:
    """Return a digest of the golden mission whose _SHARED fields have these values."""
    golden = MissionConfig(**dict(zip(_SHARED, shared, strict=True)))
    return hashlib.sha256(canonical(changes_of(golden)).encode()).hexdigest()[:16]


def canonical(value: Any) -> str:
    """Return a value as canonical JSON, so that equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def changes_of(config: MissionConfig) -> Changes:
    """Return the fields of a mission that differ from their defaults, as JSON values."""
    return {
        name: plain
        for name in _NAMES
        if (value := getattr(config, name)) != (default := getattr(_DEFAULT, name))
        and (plain := _plain(value)) != _plain(default)
    }


def _plain(value: Any) -> Any:
    """Convert a value as a JSON round trip would, without the slow copies of `asdict`."""
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    members = getattr(value, "__dataclass_fields__", None)
    if members is None:
        return value
    return {
        name: _plain(getattr(value, name))
        for name, member in members.items()
        if not is_omitted(value, member)
    }


def kind_of(changes: Changes, apart: Collection[str]) -> str:
    """Return a mission's kind: its fields as canonical JSON, without the seeds of its fault.

    Args:
        changes: the mission's fields from `changes_of`.
        apart: names of the fields to leave out.
    """
    kind = {name: value for name, value in changes.items() if name not in apart}
    for name in ("fault", "instruction"):
        if kind.get(name) is not None:
            own = {key: value for key, value in kind[name].items() if key != "invocation_seed"}
            kind[name] = {**own, "seed": 0}
    return canonical(kind)


def label_text(labels: Labels) -> str:
    """Return a setting's labels as a phrase, such as `setting=FI world=farm`, in display order."""
    phrases = (f"{name}={label_value(labels[name])}" for name in ordered(labels))
    return " ".join(phrases) or "all missions"


def label_value(value: Label) -> str:
    """Return a label's value as text, with booleans in lower case as in a specification."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def ordered(names: Iterable[str]) -> list[str]:
    """Return the distinct names of labels in display order: `_FIRST`, then alphabetically."""
    unordered = set(names)
    return [name for name in _FIRST if name in unordered] + sorted(unordered - set(_FIRST))


@contextlib.contextmanager
def naming(labels: Labels) -> Iterator[None]:
    """Append the labels of a setting to the message of any error raised in the block.

    Raises:
        ConfigError: replaces any MavfiError and keeps its exit code.
    """
    try:
        yield
    except MavfiError as error:
        place = f" (in {label_text(labels)})" if labels else ""
        named = ConfigError(f"{error}{place}")
        named.exit_code = error.exit_code
        raise named from None


class MissingMission(NamedTuple):
    """A mission without a result: its number, its setting's number, and its configuration."""

    number: int
    cell: int
    config: MissionConfig


class Sampling(Enum):
    """How the faults of a campaign are drawn."""

    UNIFORM = "uniform"  # each fault independently, by the rule for its level
    STRATIFIED = "stratified"  # in rounds, more where outcomes have varied; missions have weights


class ResultState(Enum):
    """Whether a finished mission was flown, or could not begin."""

    FLOWN = "flown"  # it ended with the given `outcome`
    ERROR = "error"  # it could not begin, so it has no result and is not counted


# Fate by the activation in a record; any other activation means active.
_BY_ACTIVATION = {
    "read": "active",
    "withheld": "active",
    "unchanged": "not_activated",
    "not_read": "not_activated",
    "not_injected": "not_injected",
    "overwritten": "not_activated",
    "ended_before_read": "not_activated",
    "not_read_in_window": "unread",
}


class Injected(Enum):
    """The fate of a flown mission's fault."""

    GOLDEN = "golden"  # the mission has no fault
    ACTIVE = "active"  # it struck, and what it struck was read afterwards
    UNREAD = "unread"  # it struck, and nothing read the value while it was tracked
    CAUGHT = "caught"  # it struck, and a detector withheld it before anything read it
    NOT_ACTIVATED = "not_activated"  # it struck a value that nothing read before it expired
    NOT_INJECTED = "not_injected"  # the mission ended, or the run diverged, before the trigger
    NULL = "null"  # a null injection, which leaves out the flip

    @classmethod
    def of(cls, flight: FlightRecord, *, faulty: bool) -> Injected:
        """Return the fate of a mission's fault, derived from the record of the flight.

        Args:
            faulty: whether the mission was planned with a fault.
        """
        fault = flight.fault
        if not faulty:
            return cls.GOLDEN
        if fault is None or fault.state in ("planned", "not_injected"):
            return cls.NOT_INJECTED
        if fault.state == "null":
            return cls.NULL
        activation = fault.activation
        read = "read" if activation is None else activation.activation  # cut off: may have been
        fate = cls(_BY_ACTIVATION.get(read, "active"))
        return cls.CAUGHT if fate is cls.NOT_ACTIVATED and _caught(flight) else fate


def _caught(flight: FlightRecord) -> bool:
    """Return True if an alarm that did not let its message pass matches a strike of the fault.

    An alarm matches if it has the stamp of a strike, or if it concerns a struck state and does not
    precede the first strike.
    """
    stamps = {strike.stamp_s for strike in flight.strikes}
    states = {change.state for strike in flight.strikes for change in strike.changes}
    alarms = () if flight.detection is None else flight.detection.alarms
    return any(
        alarm.response != "accept"
        and (
            alarm.stamp_s in stamps
            or (alarm.stamp_s >= min(stamps) and not states.isdisjoint(alarm.states))
        )
        for alarm in (alarms if stamps else [])
    )


# Fates of the missions that count: no fault, a null fault, or one that could affect the success.
COUNTED = frozenset(
    fate.value for fate in Injected if fate not in (Injected.NOT_ACTIVATED, Injected.NOT_INJECTED)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionResult:
    """One finished mission, as the ledger stores it.

    Attributes:
        result: its result.json, as `mavfi fly` writes it. If the mission crashed or hung before it
            could write one, only the known fields. Empty for an error.
        injected: the fate of its fault; None for an error.
        reason: the record's reason for the outcome, or why the mission could not begin.
        wall_s: wall time of the final attempt, in seconds.
        attempts: number of attempts; above 1 if something outside the mission spoilt an attempt.
        path: absolute path of the kept run folder; None if it was not kept.
        stratum, weight: stratum and weight in a stratified sample; None and 1 in a uniform one.
    """

    number: int
    mission: PlannedMission
    state: ResultState
    outcome: str | None
    reason: str
    result: Json
    injected: Injected | None
    wall_s: float
    attempts: int
    path: Path | None
    stratum: str | None = None
    weight: float = 1.0

    @property
    def flight(self) -> FlightRecord:
        """The result as a typed record."""
        return FlightRecord.of(self.result)
