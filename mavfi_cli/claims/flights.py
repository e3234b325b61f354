"""One flight of a campaign, as the counts of the page need it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pyarrow as pa

from mavfi_cli.campaigns.missions import Injected, ResultState, canonical
from mavfi_cli.core.types import Outcome, Stage
from mavfi_cli.spec.detector import PAPER

EVERY_STAGE = "+".join(stage.value for stage in Stage)
LONGER = 1.05  # a flight is longer if it takes more than this times its own golden flight
_STRUCK = frozenset(
    each.value
    for each in (Injected.ACTIVE, Injected.UNREAD, Injected.CAUGHT, Injected.NOT_ACTIVATED)
)
_FAULTS = ("fault", "instruction")
_APART = (*_FAULTS, "detector", "isolate", "stack")  # what flights of one scene may differ in
# A mission is one of the paper's if it differs from the defaults in these only, and if its fault is
# one flip.
_PAPER = {*_APART, "world", "seed", "world_seed", "planner", "platform", "time_limit_s"}
_FLIP = {"persistence": "transient", "effect": "flip"}


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownMission:
    """A mission that flew: its row of `mavfi campaign export`.

    Attributes:
        source: the campaign's folder, or the exported file.
        fault: the fault that was asked for, as text; equal faults have equal texts.
        scene: world, start, noise and computer, as text: what flights of all stacks share.
        protect: the protected stages, joined by "+".
        as_paper: whether all but stack and detector's model is as in the paper: vehicle, speed,
            sensors, one flip, and 13 watched states.
        struck_state, struck_bits: of several components, joined by ";".
    """

    source: Path
    fault: str
    scene: str
    as_paper: bool
    number: int
    pair: str
    world: str
    seed: int
    stack: str
    outcome: str
    injected: str
    changes: str
    world_seed: int | None = None
    planner: str | None = None
    platform: str | None = None
    level: str | None = None
    fault_target: str | None = None
    fault_field: str | None = None
    fault_bits: int | None = None
    detector: str | None = None
    protect: str | None = None
    reason: str | None = None
    activation: str | None = None
    strike_phase: str | None = None
    struck_state: str | None = None
    struck_bits: str | None = None
    struck_kernel: str | None = None
    node_ended: str | None = None
    flight_time_s: float | None = None
    distance_m: float | None = None
    min_clearance_m: float | None = None
    goal_distance_m: float | None = None
    energy_regression_j: float | None = None
    energy_propeller_j: float | None = None
    replans: int | None = None
    wall_s: float | None = None
    path: str | None = None
    check_share: float | None = None
    recovery_share_perception: float | None = None
    recovery_share_planning: float | None = None
    recovery_share_control: float | None = None

    @property
    def overhead(self) -> float | None:
        """The share of the flight time that detection and recovery take; None if not recorded."""
        shares = (
            self.check_share, self.recovery_share_perception, self.recovery_share_planning,
            self.recovery_share_control,
        )  # fmt: skip
        known = [each for each in shares if each is not None]
        return sum(known) if len(known) == len(shares) else None

    @property
    def golden(self) -> bool:
        """Whether no fault was asked for."""
        return self.injected == Injected.GOLDEN.value

    @property
    def struck(self) -> bool:
        """Whether its fault flipped a bit, read or not, as the paper counts."""
        return self.injected in _STRUCK and not self.kills_process

    @property
    def lost(self) -> bool:
        """Whether the mission did not end in success."""
        return self.outcome != Outcome.SUCCESS.value

    @property
    def kills_process(self) -> bool:
        """Whether its fault kills a process instead of flipping bits."""
        return (self.fault_target or "").startswith("process.")

    @property
    def together(self) -> bool:
        """Whether its fault strikes all components of a group at once."""
        fault = json.loads(self.fault)[0] or {}
        return bool(fault.get("together"))


_MADE = ("source", "fault", "scene", "as_paper")
_COLUMNS = tuple(each.name for each in fields(FlownMission) if each.name not in _MADE)


def flights_of(table: pa.Table, source: Path) -> list[FlownMission]:
    """The missions of an exported table that flew."""
    names = [name for name in _COLUMNS if name in table.column_names]
    states = table["state"].to_pylist()
    return [
        _flight(row, source)
        for row, state in zip(table.select(names).to_pylist(), states, strict=True)
        if state == ResultState.FLOWN.value
    ]


def _flight(row: dict[str, Any], source: Path) -> FlownMission:
    config = json.loads(row["changes"])
    return FlownMission(
        source=source,
        fault=canonical([config.get(name) for name in _FAULTS]),
        scene=canonical({name: each for name, each in config.items() if name not in _APART}),
        as_paper=_as_paper(config),
        **row,
    )


def _as_paper(config: Mapping[str, Any]) -> bool:
    fault = config.get("fault") or {}
    watch = (config.get("detector") or {}).get("watch", PAPER)
    flips = all(fault.get(name, value) == value for name, value in _FLIP.items())
    return config.keys() <= _PAPER and flips and watch == PAPER


def where(flights: Iterable[FlownMission], **values: Any) -> list[FlownMission]:
    """The flights whose columns have these values; a tuple allows several."""
    asked = {name: each if isinstance(each, tuple) else (each,) for name, each in values.items()}
    return [
        flight
        for flight in flights
        if all(getattr(flight, name) in allowed for name, allowed in asked.items())
    ]


def comparable(flights: Iterable[FlownMission]) -> list[FlownMission]:
    """The flights without a detector, or with one that watches all stages."""
    return where(flights, protect=(None, EVERY_STAGE))


class GoldenFlights:
    """The golden flights of a set, found by the mission that they share with others."""

    def __init__(self, flights: Iterable[FlownMission]) -> None:
        self.flights = [each for each in flights if each.golden and each.detector is None]
        self._by_pair = {each.pair: each for each in self.flights}

    def any_of(self, flight: FlownMission) -> FlownMission | None:
        """The golden flight of the same mission; None if it is not there."""
        return self._by_pair.get(flight.pair)

    def of(self, flight: FlownMission) -> FlownMission | None:
        """The golden flight of the same mission; None if it was lost or is not there."""
        own = self.any_of(flight)
        return None if own is None or own.lost else own

    def ratio(self, flight: FlownMission) -> float | None:
        """Flight time over that of its own golden flight; None if either was lost."""
        own = self.of(flight)
        if own is None or flight.lost or not (flight.flight_time_s and own.flight_time_s):
            return None
        return flight.flight_time_s / own.flight_time_s

    def harmed(self, flight: FlownMission) -> bool:
        """Whether a mission is lost, or takes more than 5 % longer than its golden flight."""
        return flight.lost or (self.ratio(flight) or 0.0) > LONGER

    def paired(self, flights: Iterable[FlownMission]) -> list[FlownMission]:
        """The flights whose golden flight is there and succeeds."""
        return [each for each in flights if self.of(each) is not None]

    def ratios(self, flights: Sequence[FlownMission]) -> list[float]:
        """The ratios of the flights that have one."""
        return [each for each in map(self.ratio, flights) if each is not None]
