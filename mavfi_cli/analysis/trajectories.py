"""Selects the golden, faulty and protected flights of one mission for a picture (Fig. 13)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.analysis.flights import TREATMENT, flights, number_span, untreated
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import COUNTED, Injected, Labels, ResultState
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.mission.run_folder import RESULT

_KEPT = "`mavfi campaign run --keep all` into another folder keeps them"


@dataclass(frozen=True, slots=True, kw_only=True)
class _DrawnFlight:
    """One flight of a picture.

    Attributes:
        number: number of the flight's mission.
        name: name of the flight's setting, with details only where the panel has several flights
            with that name.
        flight_time_s: flight time; None if the record has none.
        path: run folder of the flight.
    """

    number: int
    name: str
    outcome: str
    flight_time_s: float | None
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class _Panel:
    """The flights that are drawn together for one fault.

    Attributes:
        title: the fault in words; empty for golden flights alone.
        flights: golden flights first, protected flights last.
    """

    title: str
    flights: Sequence[_DrawnFlight]


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionPicture:
    """The contents of a picture of one pair: flights with the same world, start and noise.

    Attributes:
        panels: one panel for each fault; at least one.
        absent: one line per mission of the pair that is not in the picture, with the reason.
    """

    panels: Sequence[_Panel]
    absent: Sequence[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flown:
    number: int
    labels: Labels
    injected: str | None
    detector: str | None
    outcome: str
    flight_time_s: float | None
    path: Path | None

    @property
    def golden(self) -> bool:
        return self.injected == Injected.GOLDEN.value

    @property
    def cut_off(self) -> bool:
        """Whether the process that flew the mission ended before it wrote the record."""
        return self.path is not None and self.path.is_dir() and not (self.path / RESULT).is_file()

    @property
    def setting(self) -> str:
        """The name of the setting in the campaign's specification, or a description if unnamed."""
        named = self.labels.get("setting")
        if named is not None:
            return str(named)
        kind = "golden" if self.golden else "fault"
        return kind if self.detector is None else f"{kind}, {self.detector}"

    @property
    def treatment(self) -> list[str]:
        """The values of the labels that tell settings with the same name apart."""
        values = (self.labels.get(name) for name in TREATMENT[1:])
        return [
            "no detector" if value == "none" else str(value)
            for value in values
            if value is not None
        ]


def pair(
    ledger: Ledger, number: int | None = None, among: Collection[int] | None = None
) -> MissionPicture:
    """Return the flights of the pair that contains a mission, arranged for a picture.

    The flights of a pair share world, start and noise.

    Args:
        number: number of the mission. None selects, among the pairs with all run folders, the one
            in which a fault prolongs a successful flight most, relative to the golden flight time.
            If no fault does, it selects the first of these pairs.
        among: numbers of the missions to choose from and to draw; None means all.

    Raises:
        ConfigError: the campaign's list has no mission with this number.
        RecordError: no mission of the pair has been flown, not all of their run folders were kept,
            or none of the flights left a record.
    """
    listed = {row[0]: row for row in ledger.rows()}
    chosen = listed.keys() if among is None else among
    number = _most_prolonged(ledger, chosen) if number is None else number
    if number not in listed:
        problem = f"mission {number} does not exist; the list has {number_span(ledger)}"
        raise ConfigError(problem, path=ledger.folder)
    pairs = {other: pair for other, _, pair, _ in listed.values()}
    mine = [other for other in pairs if pairs[other] == pairs[number] and other in chosen]
    over = flights(ledger, mine).to_pylist()
    flown = [
        _Flown(
            number=row["number"],
            labels=json.loads(listed[row["number"]][1]),
            path=None if row["path"] is None else Path(row["path"]),
            **{name: row[name] for name in ("injected", "detector", "outcome", "flight_time_s")},
        )
        for row in over
        if row["state"] == ResultState.FLOWN.value
    ]
    if not flown:
        raise RecordError(
            f"{ledger.folder}: no mission of the pair that contains mission {number} has been flown"
        )
    lost = [flight.number for flight in flown if flight.path is None]
    if lost:
        raise RecordError(f"{ledger.folder}: no run folder of {_missions(lost)} was kept; {_KEPT}")
    whole = [flight for flight in flown if not flight.cut_off]
    if not whole:
        raise RecordError(
            f"{ledger.folder}: cannot draw {_missions(mine)}, because none of them left a record"
        )
    missing = sorted(set(mine) - {row["number"] for row in over})
    return MissionPicture(
        panels=_panels(ledger, whole),
        absent=[
            *(f"mission {row['number']} could not begin: {row['reason']}"
              for row in over if row["state"] == ResultState.ERROR.value),
            *(f"mission {flight.number}: {flight.outcome}, cut off before its record"
              for flight in flown if flight.cut_off),
            *([f"{_missions(missing)} not flown yet"] if missing else []),
        ],
    )  # fmt: skip


def _missions(numbers: Sequence[int]) -> str:
    return f"mission{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


def _most_prolonged(ledger: Ledger, among: Collection[int]) -> int:
    kept: dict[str, bool] = {}
    first: dict[str, int] = {}
    golden_s: dict[str, float] = {}
    faulty_s: dict[str, float] = {}
    names = ("number", "changes", "pair", "outcome", "injected", "flight_time_s", "path")
    for portion in ledger.columns(names):
        for number, changes, name, outcome, injected, time_s, path in zip(*portion, strict=True):
            if number not in among:
                continue
            first.setdefault(name, number)
            kept[name] = kept.get(name, True) and path is not None
            watched = "detector" in json.loads(changes)
            if outcome != "success" or time_s is None or watched:
                continue
            if injected == Injected.GOLDEN.value:
                golden_s.setdefault(name, time_s)
            elif injected in COUNTED:
                faulty_s[name] = max(time_s, faulty_s.get(name, 0.0))
    complete = [name for name in first if kept[name]]
    if not complete:
        raise RecordError(f"{ledger.folder}: no pair has all its run folders; {_KEPT}")
    increase = {name: faulty_s[name] / golden_s[name] for name in faulty_s.keys() & golden_s.keys()}
    return first[max(complete, key=lambda name: (increase.get(name, 0.0), -first[name]))]


def _panels(ledger: Ledger, flown: Sequence[_Flown]) -> list[_Panel]:
    golden = [flight for flight in flown if flight.golden]
    struck: dict[str, list[_Flown]] = {}
    for flight in flown:
        if not flight.golden:
            struck.setdefault(untreated(flight.labels), []).append(flight)
    panels = []
    for faulty in struck.values():
        (config,) = ledger.configs([faulty[0].number])
        fault = config.fault or config.instruction
        panels.append(_panel("" if fault is None else fault.describe(), golden + faulty))
    return panels or [_panel("", golden)]


def _panel(title: str, flown: Sequence[_Flown]) -> _Panel:
    ordered = sorted(
        flown, key=lambda flight: (flight.detector is not None, not flight.golden, flight.number)
    )
    often = Counter(flight.setting for flight in ordered)
    return _Panel(
        title=title,
        flights=[
            _DrawnFlight(
                number=flight.number,
                name=", ".join(
                    [flight.setting, *(flight.treatment if often[flight.setting] > 1 else [])]
                ),
                outcome=flight.outcome,
                flight_time_s=flight.flight_time_s,
                path=flight.path,
            )
            for flight in ordered
            if flight.path is not None
        ],
    )
