"""The flights of one picture: a mission golden, with faults, and protected (Fig. 13)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any

from mavfi_cli.analysis.summary import TREATMENT, untreated
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import COUNTED, Injected, MissionResult, ResultState
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.mission.measures import fields_of
from mavfi_cli.mission.run_folder import RESULT

_KEPT = "mavfi campaign run --keep all, into another folder, keeps them"


def pair(
    ledger: Ledger, number: int | None = None, among: Collection[int] | None = None
) -> dict[str, Any]:
    """The flights that share world, start and noise with a mission, panel by panel.

    Args:
        number: number of the mission. None selects the pair in which a fault prolongs a flight
            most without failing it, relative to the golden flight time, among the pairs with all
            run folders; the first pair of the list if no fault does.
        among: numbers of the missions to choose from and to draw; None means all.

    Returns:
        `panels`: a row a fault with its `title`, the fault in words, empty of golden flights; and
        its `flights`, golden ones first, protected ones last: `number` of the mission, `name` of
        its setting, as short as tells it from the others beside it, `outcome`, `flight_time_s`, and
        the `path` of its run folder. `absent`: what is not in the picture, and why, a line each.

    Raises:
        ConfigError: the list has no such mission.
        RecordError: its pair is not flown, or not all of its run folders were kept.
    """
    chosen = range(ledger.planned()) if among is None else among
    number = _most_prolonged(ledger, chosen) if number is None else number
    if not 0 <= number < ledger.planned():
        last = ledger.planned() - 1
        raise ConfigError(f"no mission {number}: the list has 0 to {last}", path=ledger.folder)
    pairs = [(each, name) for each, _, name, _ in ledger.rows()]
    mine = [each for each, name in pairs if name == pairs[number][1] and each in chosen]
    over = list(ledger.results(mine))
    flown = [each for each in over if each.state is ResultState.FLOWN]
    if not flown:
        raise RecordError(f"{ledger.folder}: nothing of mission {number}'s pair is flown")
    lost = [each.number for each in flown if each.path is None]
    if lost:
        raise RecordError(f"{ledger.folder}: no run folder of {_told(lost)} was kept; {_KEPT}")
    whole = [each for each in flown if not _cut_off(each)]
    if not whole:
        raise RecordError(f"{ledger.folder}: {_told(mine)} left no record to draw")
    missing = sorted(set(mine) - {each.number for each in over})
    errors = [each for each in over if each.state is ResultState.ERROR]
    return {
        "panels": _panels(whole),
        "absent": [
            *(f"mission {each.number} could not begin: {each.reason}" for each in errors),
            *(f"mission {each.number}: {each.outcome}, cut off before its record"
              for each in flown if _cut_off(each)),
            *([f"{_told(missing)} not flown yet"] if missing else []),
        ],
    }  # fmt: skip


def _cut_off(each: MissionResult) -> bool:
    """Whether its process ended before it wrote the trace."""
    return each.path is not None and each.path.is_dir() and not (each.path / RESULT).is_file()


def _told(numbers: Sequence[int]) -> str:
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
        raise RecordError(f"{ledger.folder}: no pair of which all run folders were kept; {_KEPT}")
    increase = {name: faulty_s[name] / golden_s[name] for name in faulty_s.keys() & golden_s.keys()}
    return first[max(complete, key=lambda name: (increase.get(name, 0.0), -first[name]))]


def _panels(flown: Sequence[MissionResult]) -> list[dict[str, Any]]:
    golden = [each for each in flown if each.injected is Injected.GOLDEN]
    struck: dict[str, list[MissionResult]] = {}
    for each in flown:
        if each.injected is not Injected.GOLDEN:
            struck.setdefault(untreated(each.mission.labels), []).append(each)
    panels = []
    for those in struck.values():
        config = those[0].mission.config
        asked = config.fault or config.instruction
        panels.append(_panel("" if asked is None else asked.words(), golden + those))
    return panels or [_panel("", golden)]


def _panel(title: str, flown: Sequence[MissionResult]) -> dict[str, Any]:
    def order(each: MissionResult) -> tuple[bool, bool, int]:
        watched = each.mission.config.detector is not None
        return watched, each.injected is not Injected.GOLDEN, each.number

    ordered = sorted(flown, key=order)
    short = [_setting(each) for each in ordered]
    often = Counter(short)
    return {
        "title": title,
        "flights": [
            {
                "number": each.number,
                "name": name if often[name] == 1 else ", ".join([name, *_treatment(each)]),
                "outcome": each.outcome,
                "flight_time_s": fields_of(each.result)["flight_time_s"],
                "path": each.path,
            }
            for name, each in zip(short, ordered, strict=True)
            if each.path is not None
        ],
    }


def _setting(each: MissionResult) -> str:
    """The name in the specification, else a description."""
    named = each.mission.labels.get("setting")
    if named is not None:
        return str(named)
    watched = each.mission.config.detector
    told = "golden" if each.injected is Injected.GOLDEN else "fault"
    return told if watched is None else f"{told}, {watched.name}"


def _treatment(each: MissionResult) -> list[str]:
    """The rest of its treatment, to tell settings of one name apart."""
    labels = each.mission.labels
    told = [str(labels[name]) for name in TREATMENT[1:] if labels.get(name) is not None]
    return ["no detector" if name == "none" else name for name in told]
